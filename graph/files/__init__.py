"""Files: named arrays with a header, and point clouds as PLY."""

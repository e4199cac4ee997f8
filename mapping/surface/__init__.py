"""One surface from all frames: a truncated signed distance volume and its triangles."""

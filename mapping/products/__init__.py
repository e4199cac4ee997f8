"""What is made of fused depth: submaps, labelled clouds, mesh, floor plan, pictures."""

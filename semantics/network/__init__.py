"""The Mask (Scoring) R-CNN in PyTorch: configuration, RPN, heads, RoIAlign, suppression."""

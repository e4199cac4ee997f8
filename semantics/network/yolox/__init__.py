"""YOLOX-Nano (Ge et al. 2021) in PyTorch: layers, network, decoding of its boxes."""

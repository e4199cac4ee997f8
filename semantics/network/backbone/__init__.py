"""Convolutional bodies: ResNet and MobileNetV2, with their batch norm."""

"""MobileNetV2 (Sandler et al. 2018) without the classifier: features of strides 4, 8, 16, 32.

Batch norm is folded into weights and biases. Index 1 inside each block is the convolution, after
its padding, as in the weight files that this body reads. Padding is TensorFlow's "SAME": a stride
of 2 pads right and bottom by one (for even sizes; images are padded to multiples of 32).
"""

from __future__ import annotations

from torch import Tensor, nn

STAGES = ((1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1),
          (6, 160, 3, 2), (6, 320, 1, 1))  # fmt: skip
"""(expansion, channels, blocks, stride of the first block) of each stage."""
ENDS = (3, 6, 13, 17)
"""The last block before each further halving: its output is a feature map."""
CHANNELS = (24, 32, 96, 320)


def _conv(channels: tuple[int, int], kernel: int, stride: int, groups: int = 1) -> list[nn.Module]:
    """Padding and convolution, as children 0 and 1."""
    pad: nn.Module = nn.ZeroPad2d((0, 1, 0, 1)) if stride == 2 else nn.Identity()
    inside = kernel // 2 if stride == 1 else 0
    return [pad, nn.Conv2d(*channels, kernel, stride, inside, groups=groups)]


def _conv_relu6(
    channels: tuple[int, int], kernel: int, stride: int, groups: int = 1
) -> nn.Sequential:
    return nn.Sequential(*_conv(channels, kernel, stride, groups), nn.ReLU6(inplace=True))


class InvertedResidual(nn.Module):
    """x + project(depthwise(expand(x))), the sum only where the shape stays."""

    def __init__(self, inputs: int, outputs: int, stride: int, expansion: int) -> None:
        super().__init__()
        hidden = inputs * expansion
        layers = [_conv_relu6((inputs, hidden), 1, 1)] if expansion > 1 else []
        layers.append(_conv_relu6((hidden, hidden), 3, stride, groups=hidden))
        layers.append(nn.Sequential(*_conv((hidden, outputs), 1, 1)))
        self.conv = nn.Sequential(*layers)
        self.residual = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        return x + self.conv(x) if self.residual else self.conv(x)


class MobileNetV2(nn.Module):
    """Stem and seventeen blocks."""

    def __init__(self) -> None:
        super().__init__()
        blocks: list[nn.Module] = [_conv_relu6((3, 32), 3, 2)]
        inputs = 32
        for expansion, outputs, count, first_stride in STAGES:
            for k in range(count):
                stride = first_stride if k == 0 else 1
                blocks.append(InvertedResidual(inputs, outputs, stride, expansion))
                inputs = outputs
        self.features = nn.Sequential(*blocks)

    def forward(self, x: Tensor) -> list[Tensor]:
        """Features with 24, 32, 96 and 320 channels of images (B, 3, H, W)."""
        features = []
        for i, block in enumerate(self.features):
            x = block(x)
            if i in ENDS:
                features.append(x)
        return features

"""ResNet-50 and -101 (He et al. 2016) without the classifier: features of strides 4, 8, 16, 32.

Names as in torchvision. By default the stride sits in the 3x3 convolution ("ResNet v1.5").
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional as F

from bmask_slam.semantics.network.backbone.layers import conv_norm, make_norm
from bmask_slam.semantics.network.config import NetworkConfig

BLOCKS = {"resnet50": (3, 4, 6, 3), "resnet101": (3, 4, 23, 3)}
EXPANSION = 4
CHANNELS = (256, 512, 1024, 2048)


class Downsample(nn.Sequential):
    """1x1 convolution with norm on the shortcut, where the shape changes."""

    def forward(self, x: Tensor) -> Tensor:
        """The shortcut's features."""
        return conv_norm(self[0], self[1], x)  # type: ignore[arg-type]


class Bottleneck(nn.Module):
    """relu(shortcut(x) + conv1x1(conv3x3(conv1x1(x))))."""

    def __init__(self, inputs: int, width: int, stride: int, config: NetworkConfig) -> None:
        super().__init__()
        kind, eps, outputs = config.norm, config.norm_eps, width * EXPANSION
        first, second = (stride, 1) if config.stride_in_1x1 else (1, stride)
        self.conv1 = nn.Conv2d(inputs, width, 1, first, bias=False)
        self.bn1 = make_norm(kind, width, eps)
        self.conv2 = nn.Conv2d(width, width, 3, second, 1, bias=False)
        self.bn2 = make_norm(kind, width, eps)
        self.conv3 = nn.Conv2d(width, outputs, 1, bias=False)
        self.bn3 = make_norm(kind, outputs, eps)
        self.downsample = None
        if stride > 1 or inputs != outputs:
            conv = nn.Conv2d(inputs, outputs, 1, stride, bias=False)
            self.downsample = Downsample(conv, make_norm(kind, outputs, eps))

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, 4 width, H / stride, W / stride)."""
        shortcut = x if self.downsample is None else self.downsample(x)
        y = F.relu_(conv_norm(self.conv1, self.bn1, x))
        y = F.relu_(conv_norm(self.conv2, self.bn2, y))
        return F.relu_(conv_norm(self.conv3, self.bn3, y) + shortcut)


class ResNet(nn.Module):
    """Stem and four stages."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = make_norm(config.norm, 64, config.norm_eps)
        inputs, widths, strides = 64, (64, 128, 256, 512), (1, 2, 2, 2)
        for i, count in enumerate(BLOCKS[config.backbone]):
            blocks = []
            for k in range(count):
                stride = strides[i] if k == 0 else 1
                blocks.append(Bottleneck(inputs, widths[i], stride, config))
                inputs = widths[i] * EXPANSION
            self.add_module(f"layer{i + 1}", nn.Sequential(*blocks))

    def forward(self, x: Tensor) -> list[Tensor]:
        """Features (B, 256 * 2^i, H / (4 * 2^i), W / (4 * 2^i)) of images (B, 3, H, W)."""
        x = F.relu_(conv_norm(self.conv1, self.bn1, x))
        x = F.max_pool2d(x, 3, 2, 1)
        features = []
        for name in ("layer1", "layer2", "layer3", "layer4"):
            x = self.get_submodule(name)(x)
            features.append(x)
        return features

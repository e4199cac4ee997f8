"""The configuration of a network, and the named variants."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

Backbone = Literal["resnet50", "resnet101", "mobilenet_v2"]


@dataclass(frozen=True)
class ImageConfig:
    """How an image becomes the network's input.

    Attributes:
        short_px: length that the shorter side is scaled to, unless the longer side would exceed
            ``long_px``.
        long_px: largest length of the longer side.
        mean, std: of red, green, blue in 0..1, for normalisation.
    """

    short_px: int = 800
    long_px: int = 1333
    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class AnchorConfig:
    """The anchor boxes at every cell of a level.

    Attributes:
        sizes_px: square root of their area, one a level, finest first.
        ratios: height over width of each.
        half_ratios: height over width of additional anchors of half the level's size, for objects
            that are smaller than the finest level's size, or thin.
    """

    sizes_px: tuple[float, ...] = (32, 64, 128, 256, 512)
    ratios: tuple[float, ...] = (0.5, 1.0, 2.0)
    half_ratios: tuple[float, ...] = ()

    @property
    def count(self) -> int:
        """Number of anchors of a cell."""
        return len(self.ratios) + len(self.half_ratios)


@dataclass(frozen=True)
class ProposalConfig:
    """How the RPN's boxes are selected.

    Attributes:
        before_nms: number of best boxes of each pyramid level before the suppression.
        after_nms: number of best boxes after it.
        nms_iou: overlap above which the worse of two boxes is removed.
    """

    before_nms: int = 1000
    after_nms: int = 1000
    nms_iou: float = 0.7


@dataclass(frozen=True)
class DetectionConfig:
    """Which classified boxes become detections."""

    min_score: float = 0.05
    nms_iou: float = 0.5
    max_count: int = 100


@dataclass(frozen=True)
class NetworkConfig:
    """The architecture. Two networks with equal values have equal parameter names and shapes.

    Attributes:
        classes: number of classes, background (0) included.
        backbone: the convolutional body under the feature pyramid.
        channels: channels of every pyramid level.
        norm: "frozen": batch norm with fixed statistics in the body only (torchvision's v1).
            "batch": batch norm in body, pyramid and heads (v2). "none": no batch norm, since it is
            folded into the weights (MobileNetV2).
        norm_eps: added to the variance. torchvision sets it to 0 for its published v1 weights.
        stride_in_1x1: the bottleneck's stride sits in its first convolution, as in the ResNets
            of Caffe and of the original Mask Scoring R-CNN, and not in the 3x3 one.
        rpn_convs: 3x3 convolutions in front of the RPN's two outputs.
        box_convs: 3x3 convolutions in the box head, followed by one hidden layer; none: by two.
        box_hidden: width of these layers.
        mask_channels: channels of the mask head's four 3x3 convolutions.
        maskiou_channels: the same of the MaskIoU head; 0: there is no such head.
        maskiou_hidden: width of its two hidden layers.
        class_agnostic: one mask and one IoU a box instead of one for each class (He et al. 2017,
            section 4.2), so that all objects train the same mask where classes have few examples.
        mask_context: factor by which boxes are enlarged about their centres for masks and IoUs, so
            that a mask can extend beyond a box that is too small.
    """

    classes: int = 91
    backbone: Backbone = "resnet50"
    channels: int = 256
    norm: Literal["frozen", "batch", "none"] = "frozen"
    norm_eps: float = 1e-5
    stride_in_1x1: bool = False
    rpn_convs: int = 1
    box_convs: int = 0
    box_hidden: int = 1024
    mask_channels: int = 256
    maskiou_channels: int = 0
    maskiou_hidden: int = 1024
    class_agnostic: bool = False
    mask_context: float = 1.0
    image: ImageConfig = ImageConfig()
    anchors: AnchorConfig = AnchorConfig()
    proposals: ProposalConfig = ProposalConfig()
    detections: DetectionConfig = DetectionConfig()

    @property
    def mask_outputs(self) -> int:
        """Number of masks, and of IoUs, predicted for each box."""
        return 1 if self.class_agnostic else self.classes

    def with_maskiou(self) -> NetworkConfig:
        """The same network with a MaskIoU head as wide as the mask head."""
        return replace(self, maskiou_channels=self.mask_channels)


RESNET50 = NetworkConfig()
"""torchvision's maskrcnn_resnet50_fpn."""
RESNET50_V2 = NetworkConfig(norm="batch", rpn_convs=2, box_convs=4)
"""torchvision's maskrcnn_resnet50_fpn_v2."""
RESNET101 = NetworkConfig(backbone="resnet101")
LIGHT = NetworkConfig(
    classes=81,
    backbone="mobilenet_v2",
    channels=64,
    norm="none",
    box_hidden=512,
    mask_channels=80,
    maskiou_channels=80,
    maskiou_hidden=256,
    class_agnostic=True,
    mask_context=1.2,
    image=ImageConfig(480, 800, mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5)),
    anchors=AnchorConfig(half_ratios=(1.0, 2.0, 4.0)),
    proposals=ProposalConfig(before_nms=1000, after_nms=600),
    detections=DetectionConfig(max_count=130),
)
"""For robots without a GPU: MobileNetV2 and narrow heads; 640x480 is not enlarged."""

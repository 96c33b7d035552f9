"""G, the direction code of NeRFusion (section 3.1): a viewing direction as 16 numbers."""

from __future__ import annotations

from torch import Tensor, nn

LAYERS = 5


class DirectionCode(nn.Sequential):
    """MLP of five layers: (N, 3) unit directions, working frame → (N, channels)."""

    def __init__(self, channels: int = 16) -> None:
        layers: list[nn.Module] = []
        for number in range(LAYERS):
            linear = nn.Linear(3 if number == 0 else channels, channels)
            nn.init.kaiming_normal_(linear.weight, nonlinearity="relu" if number < LAYERS - 1 else "linear")
            nn.init.zeros_(linear.bias)
            layers += [linear, nn.ReLU()]
        super().__init__(*layers[:-1])

    def forward(self, directions: Tensor) -> Tensor:
        codes: Tensor = super().forward(directions)
        return codes

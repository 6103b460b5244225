"""The encoder half of Point Transformer V3 (Wu et al. 2024) in plain PyTorch, with the published names of tensors.

The published program takes sparse convolution, attention and pooling from packages that need CUDA; here they are sums
over 27 shifted neighbors, attention in patches of PyTorch's own, and a scattered maximum. Differences: orders of points
are not shuffled, stochastic depth is off, and of several points in one voxel the first stands for their voxel in the
convolutions of the others.
"""

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

GRID = 384
"""Voxels along the unit cube."""
_SHIFTS = tuple(product((-1, 0, 1), repeat=3))


@dataclass(frozen=True)
class EncoderSizes:
    """Sizes of the encoder, stage by stage."""

    channels: tuple[int, ...] = (64, 96, 128, 256, 512)
    depths: tuple[int, ...] = (2, 2, 2, 6, 2)
    heads: tuple[int, ...] = (2, 4, 8, 16, 32)
    strides: tuple[int, ...] = (2, 2, 4, 4)
    """Voxels along one of the next stage; powers of two."""
    patch: int = 1024
    """Points that attend to each other."""


@dataclass(frozen=True, eq=False)
class Voxels:
    """Points in a grid, and their orders along four space-filling curves."""

    places: Int[Tensor, "points 3"]
    codes: Int[Tensor, "orders points"]
    """Along z-order and Hilbert's curve, and along both with x and y exchanged."""

    @classmethod
    def of(cls, centers: Float[Tensor, "points 3"]) -> "Voxels":
        """Return points of the unit cube in the finest grid."""
        places = (centers * GRID).floor().long().clamp(min=0)
        bits = max(1, int(places.max()).bit_length())
        exchanged = places[:, [1, 0, 2]]
        codes = [z_order(places, bits), z_order(exchanged, bits), hilbert(places, bits), hilbert(exchanged, bits)]
        return cls(places, torch.stack(codes))

    @cached_property
    def orders(self) -> Int[Tensor, "orders points"]:
        """Points in the order of each curve."""
        return self.codes.argsort(dim=1, stable=True)

    @cached_property
    def neighbors(self) -> Int[Tensor, "27 points"]:
        """Row of a point in each neighboring voxel, shifted by -1, 0, 1 along x, y, z, z fastest; -1 for none."""
        side = int(self.places.max()) + 3
        weights = torch.tensor([side * side, side, 1], device=self.places.device)
        keys = ((self.places + 1) * weights).sum(1)
        known, first = keys.sort(stable=True)
        rows = []
        for shift in _SHIFTS:
            wanted = keys + int((torch.tensor(shift) * weights.cpu()).sum())
            found = torch.searchsorted(known, wanted).clamp(max=len(known) - 1)
            rows.append(torch.where(known[found] == wanted, first[found], -1))
        return torch.stack(rows)

    def coarser(self, stride: int) -> tuple["Voxels", Int[Tensor, " points"]]:
        """Return the occupied voxels of a grid coarser by `stride`, along z-order, and each point's row in it."""
        bits = stride.bit_length() - 1
        codes = self.codes >> (3 * bits)
        kept, cluster = torch.unique(codes[0], return_inverse=True)
        head = torch.full((len(kept),), len(cluster), device=cluster.device)
        head = head.scatter_reduce(0, cluster, torch.arange(len(cluster), device=cluster.device), "amin")
        return Voxels(self.places[head] >> bits, codes[:, head]), cluster


def z_order(places: Int[Tensor, "points 3"], bits: int) -> Int[Tensor, " points"]:
    """Return places along Morton's curve: the bits of x, y and z in turn, from the highest on."""
    code = torch.zeros_like(places[:, 0])
    for bit in range(bits - 1, -1, -1):
        for axis in range(3):
            code = (code << 1) | ((places[:, axis] >> bit) & 1)
    return code


def hilbert(places: Int[Tensor, "points 3"], bits: int) -> Int[Tensor, " points"]:
    """Return places along Hilbert's curve (Skilling 2004, "Programming the Hilbert curve")."""
    axes = list(places.unbind(1))
    for bit in range(bits - 1, 0, -1):
        low = (1 << bit) - 1
        for axis in range(3):
            is_set = (axes[axis] >> bit) & 1 == 1
            swapped = (axes[0] ^ axes[axis]) & low
            first = torch.where(is_set, axes[0] ^ low, axes[0] ^ swapped)
            if axis:
                axes[axis] = torch.where(is_set, axes[axis], axes[axis] ^ swapped)
            axes[0] = first
    for axis in (1, 2):
        axes[axis] = axes[axis] ^ axes[axis - 1]
    turn = torch.zeros_like(axes[0])
    for bit in range(bits - 1, 0, -1):
        turn = torch.where((axes[2] >> bit) & 1 == 1, turn ^ ((1 << bit) - 1), turn)
    return z_order(torch.stack([each ^ turn for each in axes], dim=1), bits)


class SubmanifoldConvolution(nn.Module):
    """A convolution of 3 x 3 x 3 voxels whose output is at the occupied voxels alone."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(channels, 3, 3, 3, channels) / (27 * channels) ** 0.5)
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, features: Float[Tensor, "points dim"], voxels: Voxels) -> Float[Tensor, "points dim"]:
        """Return the convolved features."""
        result = self.bias.expand_as(features)
        weights = self.weight.flatten(1, 3).unbind(1)
        for rows, weight in zip(voxels.neighbors, weights, strict=True):
            here = torch.nonzero(rows >= 0)[:, 0]
            result = result.index_add(0, here, features[rows[here]] @ weight.T)
        return result


class SerializedAttention(nn.Module):
    """Attention among points that follow one another along a curve."""

    def __init__(self, channels: int, heads: int, patch: int) -> None:
        super().__init__()
        self.heads, self.patch = heads, patch
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(
        self, features: Float[Tensor, "points dim"], order: Int[Tensor, " points"]
    ) -> Float[Tensor, "points dim"]:
        """Return attended features; `order` is of the points along the curve."""
        count = len(order)
        patch = min(count, self.patch)
        places = torch.arange(-(-count // patch) * patch, device=order.device)
        # The last patch is filled up with the end of the one before.
        places[count:] -= patch
        parts = self.qkv(features)[order[places]].reshape(-1, patch, 3, self.heads, features.shape[1] // self.heads)
        query, key, value = parts.permute(2, 0, 3, 1, 4)
        found = torch.nn.functional.scaled_dot_product_attention(query, key, value)
        found = found.transpose(1, 2).reshape(-1, features.shape[1])[:count]
        attended: Tensor = self.proj(torch.empty_like(found).index_copy(0, order, found))
        return attended


class _Block(nn.Module):
    def __init__(self, channels: int, heads: int, patch: int, order: int) -> None:
        super().__init__()
        self.order = order
        self.cpe = nn.ModuleList(
            [SubmanifoldConvolution(channels), nn.Linear(channels, channels), nn.LayerNorm(channels)]
        )
        self.norm1 = nn.Sequential(nn.LayerNorm(channels))
        self.attn = SerializedAttention(channels, heads, patch)
        self.norm2 = nn.Sequential(nn.LayerNorm(channels))
        wide = 4 * channels
        layers = {"fc1": nn.Linear(channels, wide), "act": nn.GELU(), "fc2": nn.Linear(wide, channels)}
        self.mlp = nn.Sequential(nn.Sequential(OrderedDict(layers)))

    def forward(self, features: Float[Tensor, "points dim"], voxels: Voxels) -> Float[Tensor, "points dim"]:
        convolution, linear, norm = self.cpe
        features = features + norm(linear(convolution(features, voxels)))
        features = features + self.attn(self.norm1(features), voxels.orders[self.order])
        return features + self.mlp(self.norm2(features))


class _Pooling(nn.Module):
    def __init__(self, before: int, after: int, stride: int) -> None:
        super().__init__()
        self.stride = stride
        self.proj = nn.Linear(before, after)
        self.norm = nn.Sequential(_batch_norm(after))

    def forward(
        self, features: Float[Tensor, "points dim"], voxels: Voxels
    ) -> tuple[Float[Tensor, "voxels after"], Voxels]:
        coarse, cluster = voxels.coarser(self.stride)
        projected = self.proj(features)
        rows = cluster[:, None].expand_as(projected)
        largest = projected.new_zeros(len(coarse.places), projected.shape[1])
        largest = largest.scatter_reduce(0, rows, projected, "amax", include_self=False)
        return torch.nn.functional.gelu(self.norm(largest)), coarse


class PointEncoder(nn.Module):
    """Features of the occupied voxels of the coarsest grid."""

    def __init__(self, inputs: int, sizes: EncoderSizes) -> None:
        super().__init__()
        channels = sizes.channels
        self.embedding = nn.Sequential(nn.Linear(inputs, channels[0]), _batch_norm(channels[0]), nn.GELU())
        self.enc = nn.ModuleDict()
        for stage, (width, depth, heads) in enumerate(zip(channels, sizes.depths, sizes.heads, strict=True)):
            parts: dict[str, nn.Module] = {}
            if stage:
                parts["down"] = _Pooling(channels[stage - 1], width, sizes.strides[stage - 1])
            parts |= {f"block{place}": _Block(width, heads, sizes.patch, place % 4) for place in range(depth)}
            self.enc[f"enc{stage}"] = nn.ModuleDict(parts)

    def forward(
        self, centers: Float[Tensor, "points 3"], features: Float[Tensor, "points inputs"]
    ) -> Float[Tensor, "voxels dim"]:
        """Return features of voxels, from points of the unit cube and their own features."""
        voxels = Voxels.of(centers)
        state: Tensor = self.embedding(features)
        for stage in self.enc.values():
            for part in stage.children():
                if isinstance(part, _Pooling):
                    state, voxels = part(state, voxels)
                else:
                    state = part(state, voxels)
        return state


def _batch_norm(channels: int) -> nn.BatchNorm1d:
    return nn.BatchNorm1d(channels, eps=1e-3, momentum=0.01)

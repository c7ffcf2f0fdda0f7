"""The parameter table in memory: one flat buffer, and an `nn.Module` whose parameters are views of it.

Why flat: the optimizer and the slow critic then are a handful of operations on long vectors instead of a few on each of
a hundred tensors, without PyTorch's private `_foreach` functions. Why one module whose parameter names hold slashes,
and not a tree of modules: `state_dict()` is the canonical table as it stands, and a task may call its action "forward"
or "type", which no child of an `nn.Module` can be called.
"""

import math
from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn

ROW = 64  # every tensor starts at a multiple of this many numbers: aligned for fast products, and AGC sums whole rows


class Layout:
    """Where each tensor lies in a flat buffer: in whole rows of ROW numbers, P tensors in R rows.

    The gaps behind them hold zeros and stay zero: a gradient of 0 moves nothing, and adds nothing to a norm.
    shapes: name -> shape, in the order of the buffer.
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        self.shapes = {name: tuple(shape) for name, shape in shapes.items()}
        self.sizes = {name: math.prod(shape) for name, shape in self.shapes.items()}
        self.rows = {name: -(-size // ROW) for name, size in self.sizes.items()}  # rounded up
        self.total = ROW * sum(self.rows.values())
        self._owners: dict[torch.device, Tensor] = {}
        self._folds: dict[torch.device, list[tuple[int, Tensor]]] = {}

    def views(self, flat: Tensor) -> dict[str, Tensor]:
        """name -> its part of flat [total] in its own shape, the same memory."""
        pieces = flat.split([ROW * rows for rows in self.rows.values()])
        return {
            name: piece[: self.sizes[name]].view(self.shapes[name])
            for name, piece in zip(self.shapes, pieces, strict=True)
        }

    def pack(self, tensors: Iterable[Tensor], out: Tensor | None = None) -> Tensor:
        """One flat buffer [total] out of all tensors, in the order of the names: one copy; a new buffer, or `out`."""
        pieces = []
        for (name, rows), x in zip(self.rows.items(), tensors, strict=True):
            gap = ROW * rows - self.sizes[name]
            pieces += [x.reshape(-1), x.new_zeros(gap)] if gap else [x.reshape(-1)]
        return torch.cat(pieces, out=out)

    def owners(self, device: torch.device) -> Tensor:
        """Which tensor each row belongs to: [R]."""
        if device not in self._owners:
            counts = torch.tensor(list(self.rows.values()), device=device)
            self._owners[device] = torch.arange(len(counts), device=device).repeat_interleave(counts)
        return self._owners[device]

    def folds(self, device: torch.device) -> list[tuple[int, Tensor]]:
        """How to get from one number per row [R] to one per tensor [P]: every fold makes one number of up to ROW.

        A fold is the size of a buffer and the places in it of the numbers; its other places hold zeros. Unlike a sum by
        owners, which adds in any order on a GPU, this always gives the same sum.
        """
        if device not in self._folds:
            self._folds[device], layout = [], self
            while max(layout.rows.values()) > 1:
                layout = Layout({name: (rows,) for name, rows in layout.rows.items()})  # of one number for each row
                places = torch.arange(layout.total).split([ROW * rows for rows in layout.rows.values()])
                used = torch.cat([place[:size] for place, size in zip(places, layout.sizes.values(), strict=True)])
                self._folds[device].append((layout.total, used.to(device)))
        return self._folds[device]


class Parameters(nn.Module):
    """The trained parameters under their canonical names, in canonical layouts. [CON-29] [CON-30] [AGT-1]

    Made where they stay: `to` and its relatives would give every parameter memory of its own.
    """

    def __init__(self, params: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.layout = Layout({name: tuple(x.shape) for name, x in params.items()})
        self.flat = self.layout.pack(params.values())
        for name, view in self.layout.views(self.flat).items():
            self.register_parameter(name, nn.Parameter(view))

    def mapping(self) -> dict[str, Tensor]:
        """What the functions of this package take as `params`."""
        return dict(self.named_parameters())

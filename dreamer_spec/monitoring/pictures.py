"""Pictures of open-loop predictions: images as an animation and as a strip, everything else as signals over time.

Blue is what the model had seen, orange what it predicted from actions alone, grey what belongs to an episode that began
later. The ground is white, on a dark page too.
"""

import dataclasses
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image as Pillow
from PIL import ImageColor, ImageDraw, ImageFont

from dreamer_spec.monitoring.curve import BLUE, GRAY, ORANGE
from dreamer_spec.monitoring.prediction import CONTEXT, Sequences, true_class_probabilities
from reference_numpy.transforms import symlog
from spec import Discrete, Spaces, Vector

BLACK, PALE = "#1f2937", "#dbeafe"
TRUE, MODEL, ERROR = "true", "model", "error"
MOST_SIGNALS = 24
STRIPS = 2  # sequences in a strip
FRAMES = (3, 8)  # of a strip: in the context, predicted
SMALLEST_TILE = 64  # pixels; smaller images are enlarged by a whole factor
BORDER, GAP = 3, 6  # pixels
LEFT, TOP, SMALLEST_WIDTH = 52, 24, 200  # pixels of an animation, for its words
MILLISECONDS, PAUSE = 100, 1000  # that a frame lasts, and the last one
KEPT = 10  # evaluations whose pictures stay on the disk


def draw_predictions(
    directory: Path,
    step: int,
    spaces: Spaces,
    truth: Sequences,
    predicted: Mapping[str, np.ndarray],
    context: int = CONTEXT,
) -> dict[str, Path]:
    """Draws truth and prediction of the same sequences, [B, T, ...] each; step: environment step of the evaluation, for
    the names.

    Returns:
      By name, the files in the directory: for every image key "<key>" (<step>-<key>.gif) and "<key>-strip"
      (<step>-<key>-strip.png), and "signals" (<step>-signals.png).
    """
    directory.mkdir(parents=True, exist_ok=True)
    starts = np.asarray(truth["is_first"])
    longest, colours = _longest_episodes(starts), _border_colours(starts, context)
    paths = {}
    for key in spaces.images:
        panels = _panels(truth[key], predicted[key])
        paths[key] = directory / f"{step:012d}-{key}.gif"
        _write_animation(paths[key], panels, colours, context)
        paths[f"{key}-strip"] = directory / f"{step:012d}-{key}-strip.png"
        rows = longest[:STRIPS]
        _draw_strip(panels[:, rows], colours[rows], context, f"{key}, step {step:,}").savefig(paths[f"{key}-strip"])
    signals = list(_signals(spaces, truth, predicted, longest[0]))
    paths["signals"] = directory / f"{step:012d}-signals.png"
    _draw_signals(signals, starts[longest[0]], context, f"step {step:,}").savefig(paths["signals"])
    return paths


def prune_pictures(directory: Path, step: int) -> None:
    """Removes all pictures but those of the newest `KEPT` evaluations up to `step`; later ones are from before a
    resume."""
    pictures = {
        path: path.name[:12] for path in directory.iterdir() if re.fullmatch(r"[0-9]{12}-.+\.(png|gif)", path.name)
    }
    kept = sorted({name for name in pictures.values() if int(name) <= step})[-KEPT:]
    for path, name in pictures.items():
        if name not in kept:
            path.unlink()


def _longest_episodes(is_first: np.ndarray) -> np.ndarray:
    """The sequences [B], those first whose first episode goes on for longest."""
    again = is_first[:, 1:]
    return np.argsort(-np.where(again.any(axis=1), again.argmax(axis=1), again.shape[1]), kind="stable")


# Images


def _panels(truth: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Truth, prediction and error as colours: uint8 [3, B, T, H, W, 3]. Where the error is grey, the prediction is
    right."""
    true, model = _colours(truth.astype(np.float32) / 255), _colours(np.asarray(predicted, np.float32))
    return np.round(255 * np.clip(np.stack([true, model, (model - true + 1) / 2]), 0, 1)).astype(np.uint8)


def _colours(image: np.ndarray) -> np.ndarray:
    """[..., channels] -> [..., 3]: the first three of three or four channels; else the last one, the newest of a stack,
    in grey."""
    return image[..., :3] if image.shape[-1] in (3, 4) else np.repeat(image[..., -1:], 3, axis=-1)


def _border_colours(is_first: np.ndarray, context: int) -> np.ndarray:
    """[B, T] -> [B, T] names of colours: seen, predicted, or of an episode that begins after the context."""
    predicted = np.where(np.logical_or.accumulate(is_first[:, context:], axis=1), GRAY, ORANGE)
    return np.concatenate([np.full((len(is_first), context), BLUE), predicted], axis=1)


def _tiles(panels: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """[3, columns, H, W, 3] and the colours [columns] of their borders -> one picture, enlarged, on white."""
    scale = max(1, round(SMALLEST_TILE / max(panels.shape[2:4])))
    panels = panels.repeat(scale, axis=2).repeat(scale, axis=3)
    tiles = np.empty(
        (*panels.shape[:2], panels.shape[2] + 2 * BORDER + GAP, panels.shape[3] + 2 * BORDER + GAP, 3), np.uint8
    )
    tiles[:] = 255
    for column, colour in enumerate(colours):
        tiles[:, column, :-GAP, :-GAP] = ImageColor.getrgb(str(colour))
    tiles[:, :, BORDER : -BORDER - GAP, BORDER : -BORDER - GAP] = panels
    rows, columns, height, width, _ = tiles.shape
    return tiles.transpose(0, 2, 1, 3, 4).reshape(rows * height, columns * width, 3)[:-GAP, :-GAP]


def _write_animation(path: Path, panels: np.ndarray, colours: np.ndarray, context: int) -> None:
    """A GIF of all sequences [3, B, T, H, W, 3] side by side; colours [B, T]."""
    font = ImageFont.truetype(findfont("DejaVu Sans"), 13)
    steps, frames = panels.shape[2], []
    for t in range(steps):
        picture = Pillow.fromarray(_tiles(panels[:, :, t], colours[:, t]))
        frame = Pillow.new(
            "RGB", (max(SMALLEST_WIDTH, picture.width + LEFT + GAP), picture.height + TOP + GAP), "white"
        )
        frame.paste(picture, (LEFT, TOP))
        pen = ImageDraw.Draw(frame)
        pen.text((LEFT, TOP // 2), f"t = {t}", BLACK, font, anchor="lm")
        pen.text(
            (2 * LEFT, TOP // 2),
            "seen" if t < context else "predicted",
            BLUE if t < context else ORANGE,
            font,
            anchor="lm",
        )
        for index, label in enumerate((TRUE, MODEL, ERROR)):
            pen.text((LEFT - GAP, TOP + (2 * index + 1) * (picture.height + GAP) // 6), label, BLACK, font, anchor="rm")
        frames.append(
            frame.quantize(256, Pillow.Quantize.FASTOCTREE, dither=Pillow.Dither.NONE)
        )  # median cut takes 50 times as long
    durations = [MILLISECONDS] * (steps - 1) + [PAUSE]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=False)


def _draw_strip(panels: np.ndarray, colours: np.ndarray, context: int, title: str) -> Figure:
    """Some frames of sequences [3, B, T, H, W, 3] from left to right, one sequence below the other; colours [B, T]."""
    steps = panels.shape[2]
    seen, predicted = (
        np.linspace(*ends, count) for ends, count in zip(((0, context - 1), (context, steps - 1)), FRAMES, strict=True)
    )
    times = np.unique(np.round(np.concatenate([seen, predicted])).astype(int))
    strips = [_tiles(panels[:, row][:, times], colours[row, times]) for row in range(len(colours))]
    space = np.full((3 * GAP, *strips[0].shape[1:]), 255, np.uint8)
    picture = np.concatenate([part for strip in strips for part in (strip, space)][:-1])
    height, width = picture.shape[:2]

    dpi, left, top, edge = 150, 0.55, 0.5, 0.08  # inches
    scale = 10 / width  # the picture is ten inches wide
    size = (10 + left + edge, height * scale + top + edge)
    figure = Figure(figsize=size, dpi=dpi)
    axes = figure.add_axes((left / size[0], edge / size[1], 10 / size[0], height * scale / size[1]))
    axes.imshow(picture, interpolation="nearest", aspect="auto")
    tile = (width + GAP) / len(times)
    axes.set_xticks((np.arange(len(times)) + 0.5) * tile - GAP / 2, [f"t = {t}" for t in times], fontsize=9)
    strip = strips[0].shape[0]
    middles = [
        index * (strip + 3 * GAP) + (2 * row + 1) * (strip + GAP) / 6
        for index in range(len(strips))
        for row in range(3)
    ]
    axes.set_yticks(middles, [TRUE, MODEL, ERROR] * len(strips), fontsize=9)
    axes.tick_params(length=0, top=True, labeltop=True, bottom=False, labelbottom=False)
    axes.spines[:].set_visible(False)
    figure.text(left / size[0], 1 - 0.15 / size[1], title, fontsize=10, color=BLACK, va="center")
    names = {BLUE: "seen", ORANGE: "predicted", GRAY: "new episode"}
    handles = [Patch(color=colour, label=name) for colour, name in names.items() if colour in colours[:, times]]
    legend_at = (1 - edge / size[0], 1 - 0.15 / size[1])
    figure.legend(
        handles=handles,
        loc="center right",
        bbox_to_anchor=legend_at,
        ncols=3,
        frameon=False,
        fontsize=9,
        borderaxespad=0,
    )
    return figure


# Signals


@dataclasses.dataclass(frozen=True)
class Signal:
    """One plot: true [T], or None where only the prediction is a number, and predicted [T]. spread: how much the truth
    varies."""

    name: str
    true: np.ndarray | None
    predicted: np.ndarray
    is_probability: bool = False
    spread: float = math.inf


def _signals(spaces: Spaces, truth: Sequences, predicted: Mapping[str, np.ndarray], row: int) -> Iterator[Signal]:
    """Everything of one sequence that is not an image, reward and continue first."""
    yield Signal("reward", truth["reward"][row], predicted["reward"][row])
    yield Signal("continue", 1.0 - truth["is_terminal"][row], predicted["continue_"][row], is_probability=True)
    for key, space in spaces.vectors.items():
        true, model = truth[key], predicted[key]
        if isinstance(space, Discrete):
            model = true_class_probabilities(space, true, model)
        spread = symlog(true).var(axis=(0, 1))
        for entry in range(space.array_shape[0]):
            name = key if space.array_shape[0] == 1 else f"{key}[{entry}]"
            if isinstance(space, Vector):
                yield Signal(name, true[row, :, entry], model[row, :, entry], spread=spread[entry])
            else:
                yield Signal(f"P(true {name})", None, model[row, :, entry], is_probability=True, spread=spread[entry])


def _draw_signals(signals: list[Signal], is_first: np.ndarray, context: int, title: str) -> Figure:
    """A page of small plots of one sequence: those that vary most, in their order."""
    shown = sorted(sorted(range(len(signals)), key=lambda index: -signals[index].spread)[:MOST_SIGNALS])
    rows = math.ceil(len(shown) / 4)
    columns = math.ceil(len(shown) / rows)
    figure = Figure(figsize=(max(5.0, 2.75 * columns), 1.55 * rows + 0.75), dpi=150, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for place, (axes, index) in enumerate(zip(grid.flat, shown, strict=False)):
        _draw_signal(axes, signals[index], is_first, context)
        if place + columns >= len(shown):  # nothing stands below
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("t", fontsize=8)
    for axes in grid.flat[len(shown) :]:
        axes.remove()
    count = (
        f"{len(shown)} signals"
        if len(shown) == len(signals)
        else f"the {len(shown)} of {len(signals)} signals that vary most"
    )
    handles = [
        Line2D([], [], color=BLACK, linewidth=1.8, label=TRUE),
        Line2D([], [], color=BLUE, linewidth=1.4, label="model, observation seen"),
        Line2D([], [], color=ORANGE, linewidth=1.4, label="model, predicted"),
        Patch(color=PALE, label="context"),
    ]
    if is_first[1:].any():
        handles.append(Line2D([], [], color=BLACK, linewidth=0.8, linestyle=":", label="new episode"))
    figure.suptitle(f"{title}, {count}", x=0.01, ha="left", fontsize=10, color=BLACK)
    figure.legend(handles=handles, loc="outside lower left", ncols=len(handles), frameon=False, fontsize=8)
    return figure


def _draw_signal(axes: Axes, signal: Signal, is_first: np.ndarray, context: int) -> None:
    times = np.arange(len(signal.predicted))
    axes.axvspan(-0.5, context - 0.5, color=PALE, linewidth=0)
    for start in times[1:][is_first[1:]]:
        axes.axvline(start - 0.5, color=BLACK, linewidth=0.8, linestyle=":")
    if signal.true is not None:
        axes.plot(times, signal.true, color=BLACK, linewidth=1.8)
    axes.plot(times[context - 1 :], signal.predicted[context - 1 :], color=ORANGE, linewidth=1.4)
    axes.plot(times[:context], signal.predicted[:context], color=BLUE, linewidth=1.4)
    axes.set_title(signal.name, loc="left", fontsize=8, color=BLACK, pad=3)
    axes.tick_params(labelsize=7, length=2)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlim(-0.5, len(times) - 0.5)
    axes.set_ylim(*_limits(signal))


def _limits(signal: Signal) -> tuple[float, float]:
    """Both ends of an axis with all of the truth on it, and of the prediction what does not make the truth a flat
    line."""
    if signal.true is None or signal.is_probability:
        return -0.05, 1.05
    low, high = float(signal.true.min()), float(signal.true.max())
    span = max(high - low, 0.2 * max(abs(low), abs(high)), 1e-3)
    model = np.clip(signal.predicted[np.isfinite(signal.predicted)], low - 4 * span, high + 4 * span)
    low, high = min(low, *model), max(high, *model)
    pad = 0.05 * max(high - low, span)
    return low - pad, high + pad

"""Figures 1 to 6 of the paper."""

from typing import Any

import numpy as np

from benchmarks import figures as plotting
from benchmarks.gm_mpf import sizes
from benchmarks.gm_mpf.filters import NAMES
from benchmarks.gm_mpf.runs import Step, errors_by_size
from benchmarks.gm_mpf.targets import Targets
from mpfjax.vision.files import drawing


def draw_migration(found: dict[str, dict[int, Step]], size: int, targets: Targets) -> Any:
    """Figures 1 and 2: where the particles of one run are, coloured by the target they stand for.

    Four frames, among them the first, the one in which the targets are closest, and the last,
    cropped to where both are.
    """
    gaps = np.linalg.norm(targets.truth[:, 0, :2] - targets.truth[:, 1, :2], axis=1)
    closest, last = int(np.argmin(gaps)), len(gaps) - 1
    middle = closest // 2 if 2 * closest > last else (closest + last) // 2
    chosen = sorted({0, middle, closest, last})
    crop = _region(targets)
    height = crop[0].stop - crop[0].start
    zoom = max(1, round(360 / height))
    rows = []
    for name in (name for name in ("pf", "mpf", "gm_mpf") if name in found):
        step = found[name][size]
        pictures = [
            _annotated(targets.stills[t], step.centres[0, t], step.target[0, t], zoom, crop)
            for t in chosen
        ]
        rows.append((NAMES[name], pictures))
    titles = [f"frame {targets.first + t}" for t in chosen]
    return plotting.draw_contact_sheet(rows, titles)


def _annotated(
    still: np.ndarray, centres: np.ndarray, target: np.ndarray, zoom: int, crop: tuple
) -> np.ndarray:
    canvas = still[crop].repeat(zoom, axis=0).repeat(zoom, axis=1).astype(float)
    corner = np.array([crop[1].start, crop[0].start], float)
    drawing.draw_points(canvas, zoom * (centres - corner), drawing.PALETTE[target], 0.9 * zoom)
    return np.clip(canvas, 0, 255).astype(np.uint8)


def _region(targets: Targets) -> tuple[slice, slice]:
    """The rows and columns that the targets pass through, with a box's room around."""
    centres, size = targets.truth[:, :, :2], targets.truth[:, :, 2:].max(axis=(0, 1))
    low = np.maximum(centres.min(axis=(0, 1)) - 1.2 * size, 0).astype(int)
    high = (centres.max(axis=(0, 1)) + 1.2 * size).astype(int)
    height, width = targets.stills.shape[1:3]
    return slice(low[1], min(high[1], height)), slice(low[0], min(high[0], width))


def draw_effective_sample_sizes(found: dict[str, dict[int, Step]], size: int, first: int) -> Any:
    """Figures 3 and 4: N_eff of eq. 14 in every frame, mean and spread over the seeds."""
    curves = {NAMES[name]: by_size[size].effective_sample_size for name, by_size in found.items()}
    return plotting.draw_curves(
        curves, first, xlabel="frame", ylabel=r"effective sample size $N_{eff}$",
        title=f"eq. 14, N = {size}, mean ± std over seeds",
    )  # fmt: skip


def draw_errors(
    found: dict[str, dict[int, Step]], targets: Targets, references: dict[str, np.ndarray]
) -> Any:
    """Figures 5 and 6: each target's error against the number of particles.

    Below, what of it is the Monte Carlo error of the mixtures.
    """
    lines = {name: errors_by_size(by_size, targets.truth) for name, by_size in found.items()}
    own = {name: errors_by_size(found[name], truth) for name, truth in references.items()}
    panels = [
        (
            f"target {target + 1}, from {what}",
            {
                NAMES[name]: {size: error[:, target] for size, error in by_size.items()}
                for name, by_size in those.items()
            },
        )
        for what, those in (
            ("the true box", lines),
            (f"the estimate with N = {sizes.REFERENCE_PARTICLES}", own),
        )
        for target in (0, 1)
    ]
    return plotting.draw_errors_by_size(panels, "RMSE [pixels], mean ± s.e.")

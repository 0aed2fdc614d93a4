"""Light over time as an animation, GIF or MP4: what a cube (H, W, T) of one page looks like, frame by frame."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw

from scene2spad.viewer.content import Cube
from scenes.errors import InputError, require
from scenes.files import whole_file

FRAMES = 48  # at the most
SIDE = 384  # pixels of the longer side, where the image is smaller
WHITE = 0.9  # quantile of the pixels' brightest moments that is shown white
COLOURS = 64
MILLISECONDS = 80


def write_gif(cube: Cube, path: Path, *, frames: int = FRAMES, side: int = SIDE) -> Path:
    """Write the animation as GIF, whole or not at all; it repeats."""
    pictures = [one.quantize(COLOURS, dither=Image.Dither.NONE) for one in _pictures(cube, frames, side)]
    with whole_file(path) as beside:
        pictures[0].save(
            beside,
            format="GIF",
            save_all=True,
            append_images=pictures[1:],
            duration=MILLISECONDS,
            loop=0,
            optimize=True,
        )
    return path


def write_mp4(cube: Cube, path: Path, *, frames: int = FRAMES, side: int = SIDE) -> Path:
    """Write the animation as MP4 (H.264), whole or not at all.

    The encoder comes with `pip install 'scene2spad[video]'`; raises InputError that says so where it is missing, and
    where it cannot write all frames, as on a full disk.
    """
    try:
        import imageio_ffmpeg
    except ImportError:
        message = "needs a video encoder: pip install 'scene2spad[video]', or write a .gif"
        raise InputError(f"{path}: {message}") from None
    pictures = [np.asarray(one) for one in _pictures(cube, frames, side)]
    rows, columns = (length + length % 2 for length in pictures[0].shape[:2])  # H.264 takes even sizes alone
    with whole_file(path) as beside:
        film = imageio_ffmpeg.write_frames(
            str(beside),
            (columns, rows),
            fps=1000 / MILLISECONDS,
            macro_block_size=2,
            output_params=["-f", "mp4"],
            ffmpeg_log_level="quiet",
        )
        film.send(None)
        try:
            for rgb in pictures:
                more = ((0, rows - rgb.shape[0]), (0, columns - rgb.shape[1]), (0, 0))
                film.send(np.ascontiguousarray(np.pad(rgb, more, mode="edge")))
            film.close()
            # the encoder ends without a word on a full disk: what it wrote is read again
            written, _ = imageio_ffmpeg.count_frames_and_secs(str(beside))
        except (OSError, RuntimeError):
            written = 0
        require(written == len(pictures), f"{path}: could not be written whole; is the disk full?")
    return path


def _pictures(cube: Cube, frames: int, side: int) -> list[Image.Image]:
    """Draw the frames: from the first light on, until a hundredth of it is left."""
    first, last = _lit(cube.values)
    chosen = np.linspace(first, last, min(frames, last - first + 1)).round().astype(int)
    width = max(int(np.median(np.diff(chosen))) if len(chosen) > 1 else 1, 1)
    shown = np.stack([cube.values[..., t : t + width].sum(axis=2, dtype=float) for t in chosen])
    steady = float(np.median(cube.values.mean(axis=(0, 1)))) * width
    lit = np.clip(shown - steady, 0, None)
    white = float(np.quantile(lit.max(axis=0), WHITE)) or 1.0
    return [
        _picture(np.clip(frame / white, 0, 1), _caption(cube, t + width / 2), side)
        for frame, t in zip(lit, chosen, strict=True)
    ]


def _lit(values: np.ndarray) -> tuple[int, int]:
    """First and last bin that hold more than the steady light of the image, by a hundredth of the most."""
    total = values.sum(axis=(0, 1), dtype=float)
    excess = total - np.median(total)
    lit = np.flatnonzero(excess > 0.01 * excess.max(initial=0))
    return (int(max(lit[0] - 2, 0)), int(lit[-1])) if lit.size else (0, values.shape[2] - 1)


def _caption(cube: Cube, bins: float) -> str:
    """Say a frame's time, and the depth that is seen then where time tells it."""
    at_ns = cube.start_ns + bins * cube.step_ns
    return f"{at_ns:5.1f} ns" + ("" if cube.metres_per_ns is None else f", {at_ns * cube.metres_per_ns:.2f} m")


def _picture(fraction: np.ndarray, caption: str, side: int) -> Image.Image:
    """One frame (H, W) in [0, 1], enlarged by a whole factor, with words below."""
    factor = max(1, side // max(fraction.shape))
    rgb = np.rint(255 * matplotlib.colormaps["inferno"](fraction ** (1 / 2.2))[..., :3]).astype(np.uint8)
    image = Image.fromarray(rgb.repeat(factor, axis=0).repeat(factor, axis=1))
    if image.width >= 160:  # else there is no room for words
        ImageDraw.Draw(image).text((6, image.height - 16), caption, fill="white")
    return image

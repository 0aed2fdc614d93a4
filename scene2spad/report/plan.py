"""List the results that `report` expects, in its order: figures, tables, and the command that makes each. Plain
data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Picture:
    """A figure by its file's name; `command` where another than the item's makes it."""

    file: str
    shows: str
    command: str = ""


@dataclass(frozen=True)
class Table:
    """A table by its file's name, of a .json the list of rows under `key`; `columns`: these alone. `evaluation`: that
    of an `evaluate`; the means of every folder's are shown."""

    file: str
    shows: str
    key: str = ""
    columns: tuple[str, ...] = ()
    evaluation: bool = False


@dataclass(frozen=True)
class Item:
    """One heading: pictures, tables, files that are named alone, and the command that makes them.

    published   which printed numbers stand there: depth-offset, power, memory, or STUDY/FIGURE of the ablations
    """

    anchor: str
    title: str
    command: str
    pictures: tuple[Picture, ...] = ()
    tables: tuple[Table, ...] = ()
    data: tuple[str, ...] = ()
    text: str = ""
    published: str = ""


@dataclass(frozen=True)
class Section:
    anchor: str
    title: str
    items: tuple[Item, ...]


def _ablation(study: str, figure: str, title: str, names: tuple[str, ...], text: str = "") -> Item:
    """Plan a figure of designs beside each other; with `text`, the study's first: its tables stand there, once."""
    pictures = tuple(
        Picture(
            f"{study}-{name}x.png",
            f"Error of every test image by design at {name.split('-')[-1]}x as a scatter, depth images beneath",
            "" if name.endswith("-128") else f"scene2spad study {study} --full",
        )
        for name in names
    )
    tables = (
        Table(f"{study}.json", "The paper's conclusions, and what our numbers say", "conclusions"),
        Table(f"{study}.json", "Our errors by design and photon levels", "summary"),
    )
    return Item(
        f"figure-{figure}",
        f"Figure{'s' if '-' in figure else ''} {figure.replace('-', ' to ')}: {title}",
        f"scene2spad study {study}",
        pictures,
        tables if text else (),
        (f"{study}.csv", f"{study}-summary.csv") if text else (),
        text,
        f"{study}/{figure}",
    )


_SPEED = Section(
    "speed",
    "Speed against error",
    (
        Item(
            "bench-render",
            "Rendering",
            "scene2spad bench render",
            (
                Picture("bench-render-raw.png", "Error against seconds of ours and mitransient, before the pulse"),
                Picture("bench-render-pulse.png", "Error against seconds of ours and mitransient, after the pulse"),
            ),
            (
                Table(
                    "bench-render.json",
                    "Seconds at equal error: how many times faster ours is",
                    "ratios",
                    ("scene", "size", "transport", "ours", "theirs", "kind", "error", "ratio", "at_least",
                     "ours_seconds", "theirs_seconds", "extrapolated"),
                ),
                Table("bench-render.json", "How far the two codes agree with the reference", "checks"),
            ),
            ("bench-render.csv",),
        ),
        Item("bench-sense", "Sensing", "scene2spad bench sense", tables=(
            Table("bench-sense.csv", "Seconds to timestamps and histograms beside dense Poisson draws"),)),
        Item(
            "bench-encode",
            "Encoding",
            "scene2spad bench encode",
            (Picture("bench-encode.png", "Deviation against seconds of encoding layers and of encoding alone"),),
            (Table("bench-encode.csv", "Compressive layers and encoders: seconds, deviation, speed-up"),),
        ),
        Item("bench-network", "Networks", "scene2spad bench network", tables=(
            Table("network.csv", "Depth networks: cost of a frame and of a training step, error after equal time"),)),
        Item("bench-emulate", "Emulation", "scene2spad bench emulate", tables=(
            Table("bench-emulate.csv", "The in-pixel processor and two routes to the same bits"),)),
        Item(
            "estimators",
            "Estimators without a network",
            "scene2spad bench sense",
            (Picture("bench-estimators.png", "Error of classical depth estimators at 16 photon levels"),),
            data=("bench-estimators.csv",),
        ),
    ),
)  # fmt: skip

_HARD = Section(
    "hard-cases",
    "Hard cases",
    (
        Item(
            "bench-hard-cases",
            "Scenes that break renderers",
            "scene2spad bench hard-cases",
            tables=(Table("bench-hard-cases.csv", "Every quantity of every case against its oracle and limit"),),
        ),
    ),
)

_OFFSET = "scene2spad study depth-offset"
_FIGURES = Section(
    "figures",
    "Figures of the paper's supplement",
    (
        Item(
            "figure-1",
            "Figure 1: coding tensors at 128x",
            _OFFSET,
            (
                Picture("depth-offset-1-128x.png", "Fixed and learned temporal codes at 128x as matrices and curves"),
                Picture(
                    "tensors-128x.png",
                    "Coding tensors of the paper's designs at 128x; learned ones at their random start",
                    "scene2spad study tensors",
                ),
            ),
        ),
        Item(
            "figure-2",
            "Figure 2: scenes moved 7 m out of their training depths",
            _OFFSET,
            (
                Picture("depth-offset-2.png", "Error against compression near and 7 m farther, by design"),
                Picture("depth-offset-ratios.png", "Far over near error of every seed, beside the bars set before"),
                Picture("depth-offset-sweep.png", "Error against the offset, and where training depths end"),
                Picture("depth-offset-range.png", "The end of the range: which step fails, and a wall"),
                Picture("depth-offset-cause.png", "Cause and cure: random offsets in training, swapped codes"),
                Picture("depth-offset-energy.png", "Energy of learned codes by time bin over the training"),
            ),
            (
                Table("depth-offset.json", "The bars, set before the training", "bars"),
                Table("depth-offset.json", "MAE near and 7 m farther [mm], every seed", "ratios"),
                Table("depth-offset.json", "MAE [mm] by kind of offset", "modes"),
                Table("depth-offset.json", "With random offsets in training [mm]", "cure"),
                Table("depth-offset.json", "Energy of codes beyond the training depths over that within", "energy"),
            ),
            ("depth-offset.csv", "depth-offset-summary.csv"),
            published="depth-offset",
        ),
        Item(
            "figure-3",
            "Figure 3: depth images near and 7 m farther",
            _OFFSET,
            tuple(Picture(f"depth-offset-3-{ratio}x.png", f"Truth and depth images by design at {ratio}x")
                  for ratio in (64, 128)),
        ),
        Item(
            "figure-4",
            "Figure 4: the in-pixel processor",
            "scene2spad study power",
            (
                Picture("ultraphase-power.png", "4a: processing and readout power by program, printed and emulated"),
                Picture("ultraphase-depth.png", "4b: depth images from the codes of emulated cores, by program"),
                Picture("ultraphase-shared-core.png", "Beyond the paper: 4 x 4 SPADs that share a core"),
                Picture("ultraphase-front.png", "Beyond the paper: depth error against power, bytes and clocks"),
            ),
            tables=(
                Table("ultraphase-lost.csv", "Photons lost by busy cores: emulated with arrival times, closed form"),
            ),
            data=("ultraphase-front.csv",),
        ),
        Item(
            "chip",
            "Trained codes on the in-pixel processor",
            "scene2spad study chip",
            tables=(Table("chip-compared.csv", "MAE of the float model and of the chip's integers, in pairs"),),
            data=("chip.csv", "chip-pairs.csv"),
        ),
        Item(
            "figure-5",
            "Figure 5: power table of the in-pixel processor",
            "scene2spad study power",
            data=("ultraphase.csv",),
            published="power",
        ),
        _ablation("spatial-block", "6", "spatial block, 256 time bins", ("6-32", "6-64", "6-128"),
                  "Blocks of 1 x 1 to 8 x 8 pixels."),
        _ablation("spatial-block", "7", "spatial block, 1024 time bins", ("7-32", "7-64", "7-128")),
        _ablation("tensor-size", "8-10", "size of the coding tensor", ("8-9-32", "8-64", "8-10-128"),
                  "Full and separable tensors, 1024 to 16 time bins, blocks of 4 x 4 pixels."),
        _ablation("fourier", "11", "learned and Fourier temporal codes at 64x", ("11-64",)),
        _ablation("fourier", "12", "learned and Fourier temporal codes at 128x", ("12-128",),
                  "Learned, Fourier + learned, truncated and Gray Fourier codes."),
        Item(
            "figure-13",
            "Figures 13 and 14: captures",
            "scene2spad study real-data",
            (
                Picture("real-data-256x.png", "13: captures, depth images and methods at 256x"),
                Picture("real-data-128x.png", "14: captures, depth images and methods at 128x"),
                Picture("clouds.png", "Point clouds of the captures by method"),
            ),
            (Table("real-data.csv", "Errors of every method on every capture"),),
            text="No real capture was used unless the figure says so: the published ones are not to be had, and "
            "rendered scenes in their layout stand in. They have a truth, so that errors can be told.",
        ),
        Item(
            "figure-15",
            "Figures 15 and 16, Table 1: memory",
            "scene2spad study memory",
            (
                Picture("memory-full.png", "15: compression of storage and transfer with full coding tensors"),
                Picture("memory-separable.png", "16: the same with separable coding tensors"),
            ),
            published="memory",
        ),
        Item(
            "figure-17",
            "Figure 17: coding tensors at 64x",
            _OFFSET,
            (
                Picture("depth-offset-17-64x.png", "Fixed and learned temporal codes at 64x as matrices and curves"),
                Picture(
                    "tensors-64x.png",
                    "Coding tensors of the paper's designs at 64x; learned ones at their random start",
                    "scene2spad study tensors",
                ),
            ),
        ),
    ),
)  # fmt: skip

_BEYOND = Section(
    "beyond",
    "What only a renderer can show, and codes without a network",
    (
        Item(
            "transport",
            "What rendering adds to RGB-D rates, step by step",
            "scene2spad study transport",
            (
                Picture("transport.png", "Error of every design at each step, by laser and photon level"),
                Picture("transport-ranking.png", "Differences between codes with RGB-D rates and at each later step"),
                Picture("transport-planned.png", "Error and rays of planned renders beside full ones, every scene"),
            ),
            (
                Table("transport.json", "Whether the ranking of codes changes from RGB-D rates", "conclusions"),
                Table("transport.json", "Planned against full renders, every scene: largest difference of MAE",
                      "planned_conclusions"),
                Table("transport.json", "Scenes: indirect light, mixed pixels, rays", "scenes"),
            ),
            tuple(f"transport{name}.csv" for name in ("", "-summary", "-ranking", "-planned", "-scenes")),
        ),
        Item(
            "multipath",
            "Networks and the filter where light takes several paths",
            "scene2spad study multipath",
            (Picture("multipath.png", "Error against background of networks and filter, with and without multipath"),),
            (
                Table("multipath.json", "Networks beside the filter at 50 + 50 photons", "conclusions"),
                Table("multipath.json", "MAE [mm] by room", "by_scene"),
            ),
            ("multipath.csv",),
        ),
        Item(
            "tdc",
            "Codes behind a real clock",
            "scene2spad study tdc",
            (Picture("tdc.png", "Depth error with five clocks beside the perfect one"),),
            (
                Table("tdc.json", "Depth error by method and clock, bits a pixel", "compared"),
                Table("tdc.json", "Errors of the clocks themselves [ps]", "clocks"),
            ),
            ("tdc.csv", "tdc-compared.csv"),
        ),
        Item(
            "sim-to-real",
            "A real chip's histograms, predicted",
            "scene2spad study sim-to-real",
            (
                Picture("sim-to-real-histograms.png", "Measured and predicted histograms of nine zones"),
                Picture("sim-to-real-errors.png", "Errors of shape, amplitude and range against distance"),
                Picture("sim-to-real-pose.png", "Errors of the plane's distance and tilt from single captures"),
                Picture("sim-to-real-pile-up.png", "Measured pulses at low and high flux, and the law of pile-up"),
            ),
            (
                Table("sim-to-real.csv", "Errors of the prediction by distance"),
                Table("sim-to-real-ablation.csv", "What each effect gains: it is off, the rest calibrated again"),
            ),
            ("sim-to-real-pose.csv", "sim-to-real-pile-up.csv"),
        ),
        Item(
            "render-error",
            "How much the error of a rendered set matters",
            "scene2spad study render-error",
            tables=(Table("render-error.csv", "Error of depth by quality of the render"),),
        ),
        Item(
            "codes",
            "Codes decoded without a network",
            "scene2spad study codes",
            (Picture("codes.png", "Error against the number of codes, by code, without a network"),),
            data=("codes.csv",),
        ),
        Item(
            "evaluate",
            "Trained networks beside classical estimators",
            "scene2spad evaluate CHECKPOINTS --set SET",
            tables=(Table("evaluation.csv", "Means over scenes and photon levels", evaluation=True),),
        ),
        Item(
            "demo",
            "The chain in one figure",
            "scene2spad demo",
            (Picture("demo.png", "One scene from its returns to four depth images"),),
        ),
    ),
)  # fmt: skip

SECTIONS = (_SPEED, _HARD, _FIGURES, _BEYOND)
NEVER = (
    "Real captures of the LinoSPAD prototype (S.4): they cannot be had; Figures 13 and 14 stand on rendered ones.",
    "Three of the eight Middlebury scenes of the published test set: our numbers beside its own are of the other five.",
    "Power of a chip: the published table is recomputed, its programs are emulated, no silicon was measured.",
)

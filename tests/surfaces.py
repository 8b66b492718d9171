"""The simulator's wall materials beside real pictures of pipes: a contact sheet and a table.

    python tests/surfaces.py [--stills DIR] [--out build/surfaces]

writes sheet.png and table.json into the folder and prints the table. Of every picture an annulus of lit wall is looked
at. corners: local maxima of the smaller eigenvalue of the 5 x 5 structure tensor, a 10,000 pixels, above 5 % of the
largest one (as goodFeaturesToTrack counts) and above (3 grey levels a pixel)^2, which a tracker can use
against noise. gradient: percentiles of its length over the mean grey level, per cent a pixel. contrast: standard
deviation over mean, of the whole annulus and of what remains within 32 pixels. saturated: share of pixels at 250 and
above.
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from pipefish.simulate import Scene

MATERIALS = ("concrete", "brick", "clay", "pvc", "lined")
# The real stills: where the wall is, as centre and radii of an annulus in pixels.
STILLS = {"original_frame.png": (767, 312, 120, 330), "captured_frame.png": (767, 312, 120, 330)}
# What each material is shown with: the exposure that its albedo asks for.
LIGHT = {"exposure": {"mode": "auto", "target": 90}, "lamp": {"layout": "sides", "ring_radius": 0.045}}


def box(image: np.ndarray, size: int) -> np.ndarray:
    """Mean over size x size pixels (H, W), edges repeated."""
    padded = np.pad(image, ((size // 2 + 1, size // 2), (size // 2 + 1, size // 2)), mode="edge")
    total = padded.cumsum(0).cumsum(1)
    return (total[size:, size:] - total[:-size, size:] - total[size:, :-size] + total[:-size, :-size]) / size**2


def statistics(image: np.ndarray, annulus: tuple[float, float, float, float]) -> dict[str, float]:
    """The figures that the module's text lists, of a grey picture (H, W)."""
    grey = image.astype(float)
    rows, columns = np.mgrid[: grey.shape[0], : grey.shape[1]]
    away = np.hypot(columns - annulus[0], rows - annulus[1])
    inside = (away >= annulus[2]) & (away <= annulus[3])
    gy, gx = np.gradient(grey)
    a, b, c = box(gx * gx, 5), box(gx * gy, 5), box(gy * gy, 5)
    smaller = 0.5 * (a + c) - np.sqrt(0.25 * (a - c) ** 2 + b * b)
    inner = smaller[1:-1, 1:-1]
    neighbours = [smaller[1 + i : -1 + i or None, 1 + j : -1 + j or None] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    peak = np.zeros(grey.shape, bool)
    peak[1:-1, 1:-1] = inner >= np.max(neighbours, axis=0)
    peak &= inside
    area = inside.sum() / 1e4
    strongest = smaller[inside].max()
    length = np.hypot(gx, gy)[inside] / grey[inside].mean() * 100
    mean = grey[inside].mean()
    return {
        "mean": mean,
        "corners_relative": (peak & (smaller > 0.05 * strongest)).sum() / area,
        "corners_usable": (peak & (smaller > 9)).sum() / area,
        "gradient_50": np.percentile(length, 50),
        "gradient_90": np.percentile(length, 90),
        "gradient_99": np.percentile(length, 99),
        "contrast": grey[inside].std() / mean,
        "contrast_local": (grey - box(grey, 33))[inside].std() / mean,
        "saturated": (image[inside] >= 250).mean(),
    }


def draw(material: str, changes: dict | None = None) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """A picture of a material and the annulus of its wall."""
    scene = {"diameter": 0.3, "pieces": [{"length": 6.0}], "motion": {"frames": 60, "start": 1.2}, **LIGHT}
    made = Scene(scene | {"texture": {"material": material}} | (changes or {}))
    lens = made.spec["lens"]
    return made.render(30), (lens["c_u"], lens["c_v"], 0.3 * made.circle_radius, 0.97 * made.circle_radius)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stills", type=Path, help="folder with original_frame.png and captured_frame.png")
    parser.add_argument("--out", type=Path, default=Path("build/surfaces"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    pictures = {}
    for name, annulus in STILLS.items() if args.stills else ():
        pictures[name] = (np.array(Image.open(args.stills / name).convert("L")), annulus)
    for material in MATERIALS:
        pictures[material] = draw(material)
    pictures["pvc, ring"] = draw("pvc", {"lamp": {}})
    pictures["concrete, wet"] = draw("concrete", {"texture": {"wetness": 0.8}})
    table = {name: statistics(*picture) for name, picture in pictures.items()}
    (args.out / "table.json").write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
    print(f"{'':20}" + "".join(f"{column:>17}" for column in next(iter(table.values()))))
    for name, row in table.items():
        print(f"{name:20}" + "".join(f"{value:17.3f}" for value in row.values()))
    columns, tile = 3, 640
    lines = math.ceil(len(pictures) / columns)
    sheet = Image.new("L", (columns * tile, lines * 420))
    for k, (name, (image, _)) in enumerate(pictures.items()):
        small = Image.fromarray(image).resize((tile, image.shape[0] * tile // image.shape[1]), Image.Resampling.LANCZOS)
        corner = (k % columns * tile, k // columns * 420)
        sheet.paste(small, corner)
        ImageDraw.Draw(sheet).text((corner[0] + 8, corner[1] + 6), name, fill=255)
    sheet.save(args.out / "sheet.png")


if __name__ == "__main__":
    main()

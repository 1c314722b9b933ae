"""Compares flotilla's SVG pictures, as resvg draws them, with the PNG pictures that flotilla draws.

    python3 tests/pictures.py FLOTILLA

Needs the packages resvg-py and pillow.
"""

import io
import pathlib
import subprocess
import sys
import tempfile

import resvg_py
from PIL import Image, ImageChops

CONFIG = pathlib.Path(__file__).parent.parent / "configs/generally_forward.toml"
PICTURES = {
    "layout": ["check", CONFIG],
    "curves": ["plot", "run"],
    "comparison": ["plot", "run", "other"],
    "still": ["replay", "run", "--quiet"],
}
# Programs blend the pixels at edges differently. Larger differences come from another place or colour, and are allowed
# for a small share of the pixels.
THRESHOLD, MAX_SHARE = 96, 0.001


def differing(a, b):
    """Returns the share of pixels in which a colour differs by more than THRESHOLD."""
    bands = ImageChops.difference(a, b).split()
    large = [band.point(lambda value: 255 * (value > THRESHOLD)) for band in bands]
    any_band = ImageChops.lighter(ImageChops.lighter(large[0], large[1]), large[2])
    return any_band.histogram()[255] / (a.width * a.height)


def main(flotilla):
    flotilla = pathlib.Path(flotilla).resolve()
    with tempfile.TemporaryDirectory() as folder:
        def run(*arguments):
            subprocess.run([flotilla, *map(str, arguments)], cwd=folder, check=True, stdout=subprocess.DEVNULL)

        for out, fitness in ("run", "Df"), ("other", "G"):
            run("train", CONFIG, "--generations", 8, "--fitness", fitness, "--backend", "cpu", "--quiet", "--out", out)
        drawn = {}
        for name, command in PICTURES.items():
            for kind in "svg", "png":
                run(*command, "--out", f"{name}.{kind}")
            png = Image.open(pathlib.Path(folder, f"{name}.png")).convert("RGB")
            source = str(pathlib.Path(folder, f"{name}.svg"))
            # flotilla draws PNG with 300 dots per inch.
            svg = bytes(resvg_py.svg_to_bytes(svg_path=source, dpi=300, width=png.width, height=png.height))
            svg = Image.open(io.BytesIO(svg)).convert("RGBA")
            white = Image.new("RGBA", svg.size, "white")
            svg = Image.alpha_composite(white, svg).convert("RGB").resize(png.size)
            share = differing(png, svg)
            print(f"{name}: {share:.4%} of the pixels differ")
            assert share < MAX_SHARE, name
            blank = differing(png, Image.new("RGB", png.size, "white"))
            assert blank > 10 * MAX_SHARE, f"{name} is blank"
            drawn[name] = svg
        # A canary: another picture has to differ.
        other = drawn["curves"].resize(drawn["comparison"].size)
        assert differing(other, drawn["comparison"]) > 10 * MAX_SHARE


main(sys.argv[1])

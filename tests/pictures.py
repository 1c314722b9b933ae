"""Draws SVG pictures by resvg, and compares them with the PNG pictures that flotilla draws itself.

    python3 tests/pictures.py FLOTILLA        (needs the packages resvg-py and pillow)
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
# Two programs may blend the pixels at an edge differently; what is drawn elsewhere or in another colour differs more.
EDGE, MOST = 96, 0.001


def differing(one, other):
    """Returns the share of pixels of which a colour differs by more than EDGE."""
    largest = ImageChops.difference(one, other).split()
    strong = [band.point(lambda value: 255 * (value > EDGE)) for band in largest]
    any_band = ImageChops.lighter(ImageChops.lighter(strong[0], strong[1]), strong[2])
    return any_band.histogram()[255] / (one.width * one.height)


def main(flotilla):
    flotilla = pathlib.Path(flotilla).resolve()
    with tempfile.TemporaryDirectory() as folder:
        def run(*words):
            subprocess.run([flotilla, *map(str, words)], cwd=folder, check=True, stdout=subprocess.DEVNULL)

        for out, fitness in ("run", "Df"), ("other", "G"):
            run("train", CONFIG, "--generations", 8, "--fitness", fitness, "--backend", "cpu", "--quiet", "--out", out)
        drawn = {}
        for name, command in PICTURES.items():
            for kind in "svg", "png":
                run(*command, "--out", f"{name}.{kind}")
            png = Image.open(pathlib.Path(folder, f"{name}.png")).convert("RGB")
            source = str(pathlib.Path(folder, f"{name}.svg"))
            # PNG has 300 dots per inch.
            svg = bytes(resvg_py.svg_to_bytes(svg_path=source, dpi=300, width=png.width, height=png.height))
            svg = Image.open(io.BytesIO(svg)).convert("RGBA")
            white = Image.new("RGBA", svg.size, "white")
            svg = Image.alpha_composite(white, svg).convert("RGB").resize(png.size)
            share = differing(png, svg)
            print(f"{name}: {share:.4%} of the pixels differ")
            assert share < MOST, name
            blank = differing(png, Image.new("RGB", png.size, "white"))
            assert blank > 10 * MOST, f"{name} is blank"
            drawn[name] = svg
        # The comparison has to notice another picture.
        other = drawn["curves"].resize(drawn["comparison"].size)
        assert differing(other, drawn["comparison"]) > 10 * MOST


main(sys.argv[1])

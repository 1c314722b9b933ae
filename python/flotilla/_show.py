"""Replays and learning curves."""

from __future__ import annotations

import html
import os
from typing import NamedTuple

from flotilla import _native
from flotilla._arrays import whole


class Figure:
    """A picture. In a notebook it is shown.

    Example:
        >>> run = flotilla.train(flotilla.Config.paper().replace(learning={"generations": 2}))
        >>> flotilla.plot([run]).save("curves.png")
    """

    def __init__(self, made: _native.Figure) -> None:
        self._native = made

    def svg(self) -> str:
        """The picture as SVG text."""
        return self._native.svg()

    def _repr_svg_(self) -> str:
        return self.svg()

    def save(self, path: str | os.PathLike[str], width: int | None = None) -> None:
        """Writes the picture.

        Args:
            path: a file that ends in .svg, .pdf or .png.
            width: pixels across, 100 to 8192, of a .png; None gives 300 pixels per inch.

        Raises:
            ValueError: the name ends in something else.
            OSError: the file cannot be written.
        """
        pixels = None if width is None else whole("width", width, 100, 8192)
        _native.write(os.fspath(path), self._native.file(os.fspath(path), pixels))

    def __repr__(self) -> str:
        return "<flotilla.Figure: .save(path) writes it as .svg, .pdf or .png>"


class Episode(NamedTuple):
    """One episode of a replay."""

    trial: int | None
    """None if the policies were given, as for the generation."""
    generation: int | None
    team: int | None
    """Its number in its generation or among the given teams. The champion has none."""
    best_g: float
    """G of the team, as in the run's metrics."""
    observed: int
    """POIs that it observed."""


class Replay:
    """The episodes on which teams were scored. In a notebook they are shown with a player.

    Example:
        >>> run = flotilla.train(flotilla.Config.paper().replace(learning={"generations": 5}))
        >>> run.replay(trial=0).save("team.gif", width=300)
    """

    def __init__(self, made: _native.Replay) -> None:
        self._native = made

    @property
    def episodes(self) -> list[Episode]:
        """What is played, side by side."""
        return [Episode(*episode) for episode in self._native.episodes]

    def page(self) -> str:
        """A page that plays the episodes, as HTML that needs nothing else."""
        return self._native.page()

    def _repr_html_(self) -> str:
        page = html.escape(self.page(), quote=True)
        return f'<iframe srcdoc="{page}" width="100%" height="640" style="border: 0"></iframe>'

    def still(self, step: int | None = None) -> Figure:
        """The episodes at a step, with their trails up to there; None is the last.

        Raises:
            ValueError: there is no such step.
        """
        return Figure(self._native.still(None if step is None else whole("step", step, 0, 10_000)))

    def save(
        self, path: str | os.PathLike[str], *, step: int | None = None, width: int | None = None, fps: int = 20
    ) -> None:
        """Writes the episodes.

        Args:
            path: a file that ends in .html (to be played), .gif (moving), .svg, .pdf or .png (still).
            step: of a still: None is the last.
            width: pixels across, 100 to 8192, of a .gif or .png.
            fps: pictures per second of a .gif, 1 to 50.

        Raises:
            ValueError: the name ends in something else, or there is no such step.
            OSError: the file cannot be written.
        """
        kind = os.path.splitext(os.fspath(path))[1].lower()
        if kind == ".html":
            _native.write(os.fspath(path), self.page().encode())
        elif kind == ".gif":
            pixels = None if width is None else whole("width", width, 100, 8192)
            _native.write(os.fspath(path), self._native.gif(pixels, whole("fps", fps, 1, 50)))
        elif kind in (".svg", ".pdf", ".png"):
            self.still(step).save(path, width)
        else:
            raise ValueError(f"{os.fspath(path)}: its name must end in .html, .gif, .svg, .pdf or .png")

    def __repr__(self) -> str:
        def told(episode: Episode) -> str:
            who = "champion" if episode.team is None else f"team {episode.team}"
            of = "" if episode.trial is None else f" of trial {episode.trial} generation {episode.generation}"
            return f"{who}{of} (G {episode.best_g:.2f})"

        return f"<flotilla.Replay: {', '.join(map(told, self.episodes))}>"

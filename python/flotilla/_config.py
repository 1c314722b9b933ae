"""Configs of experiments."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from flotilla import _native as native
from flotilla._arrays import count, number
from flotilla._errors import no_key


class Key(NamedTuple):
    """A key of a config.

    Example:
        >>> [key for key in flotilla.Config.reference() if key.name == "world.steps"][0].range
        '1 to 10000'
    """

    name: str
    """Dotted: `world.steps`."""
    unit: str
    kind: str
    """What its value is: a whole number, a list, one of some words."""
    range: str
    """What is allowed."""
    default: str | None
    """The default as TOML, or None if the key is required."""
    meaning: str
    paper: str
    """Section and equation of the paper, or "" if there is none."""


def _flat(sections: Mapping[str, Any]) -> list[tuple[str, Any]]:
    keys = []
    for section, entries in sections.items():
        if isinstance(entries, Mapping):
            keys += [(f"{section}.{key}", value) for key, value in entries.items()]
        else:
            keys.append((section, entries))
    return keys


class Config(Mapping[str, Any]):
    """One experiment: its world, its agents, its learning. A config cannot be changed; `replace` makes another.

    Keys that are not given have the defaults of `docs/reference/config.md`. A config can be compared, hashed, copied and
    pickled. It is a mapping of sections: `"world.steps" in config`, `dict(config)`.

    Args:
        sections: a mapping for every section of a config file: `world={"leaders": [[5, 5]], "pois": [[5, 15]]}`, and a
            list of mappings for `agents`, `pois` and `stages`. Positions may be lists or NumPy arrays `[n, 2]`, in map
            units.

    Raises:
        ConfigError: everything that is wrong, at once.

    Example:
        >>> config = flotilla.Config(world={"leaders": [[10, 5], [30, 5]], "pois": [[20, 20]], "coupling": 2})
        >>> config["world.coupling"], config["learning.population"]
        (2, 50)
    """

    __slots__ = ("_native",)
    _native: native.Config

    def __init__(self, **sections: Mapping[str, Any] | Sequence[Any]) -> None:
        self._native = native.Config.build(_flat(sections))

    @classmethod
    def _of(cls, made: native.Config) -> Config:
        config = object.__new__(cls)
        config._native = made
        return config

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Config:
        """Reads a config file (TOML).

        Raises:
            ConfigError: the file cannot be read, or everything that is wrong with it, by line.

        Example:
            >>> flotilla.Config.load("configs/chaotic.toml")["world.steps"]
            50
        """
        path = os.fspath(path)
        return cls._of(native.Config.load("./-" if path == "-" else path))

    @classmethod
    def parse(cls, text: str, name: str = "the config") -> Config:
        """Reads a config from its text (TOML). Errors use `name` for it.

        Raises:
            ConfigError: everything that is wrong with the text, by line.

        Example:
            >>> flotilla.Config.parse("[world]\\nleaders = [[1, 1]]\\npois = [[2, 2]]").num_learners
            1
        """
        return cls._of(native.Config.parse(text, name))

    @classmethod
    def paper(cls, layout: str = "generally_forward", fitness: str = "Df", paradigm: str = "leader-follower") -> Config:
        """One of the paper's experiments: `"generally_forward"`, `"strictly_forward"`, `"chaotic"` or `"eight_followers"`.

        Raises:
            ValueError: there is no such layout, fitness or paradigm.

        Example:
            >>> flotilla.Config.paper("chaotic", fitness="G")
            <flotilla.Config: 4 leaders, 16 followers, 4 POIs; leader-follower by G, 50 teams, 100 generations, 5 trials, seed 0>
        """
        config = cls._of(native.Config.paper(layout))
        return config.replace(learning={"fitness": fitness, "paradigm": paradigm})

    @staticmethod
    def reference() -> list[Key]:
        """Every key that a config can have.

        Example:
            >>> flotilla.Config.reference()[0].name
            'world.map'
        """
        return [Key(*key) for key in native.keys()]

    def replace(self, **sections: Mapping[str, Any] | Sequence[Any]) -> Config:
        """Returns this config with some keys changed. All other keys stay.

        Raises:
            ConfigError: everything that is wrong with the keys.

        Example:
            >>> config = flotilla.Config.paper("chaotic")
            >>> config.replace(learning={"fitness": "D", "generations": 50})["learning.generations"]
            50
        """
        return Config._of(self._native.replace(_flat(sections)))

    def to_toml(self) -> str:
        """The text of a config file with every key written out.

        Example:
            >>> config = flotilla.Config.paper()
            >>> flotilla.Config.parse(config.to_toml()) == config
            True
        """
        return self._native.to_toml()

    def to_dict(self) -> dict[str, Any]:
        """All sections with all keys.

        Example:
            >>> flotilla.Config.paper("chaotic").to_dict()["world"]["pois"][0]
            [10.0, 15.0]
        """
        sections: dict[str, Any] = self._native.to_dict()
        return sections

    def __getitem__(self, key: str) -> Any:
        """A key's value by its dotted name, or a section: `config["world.steps"]`, `config["world"]`."""
        found: Any = self.to_dict()
        for part in str(key).split("."):
            if not isinstance(found, dict) or part not in found:
                raise no_key(key, "key", [*self, *(name for name, _ in _flat(self.to_dict()) if "." in name)])
            found = found[part]
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(self.to_dict())

    def __len__(self) -> int:
        return len(self.to_dict())

    @property
    def num_inputs(self) -> int:
        """Number of a policy's inputs: 8, or with `[[agents]]` the most that any class that learns has."""
        return self._native.inputs

    @property
    def num_learners(self) -> int:
        """Number of agents that learn: the leaders and, in the all-leaders paradigm, everyone."""
        return self._native.learners

    @property
    def parameters(self) -> int:
        """Weights of one policy, biases included."""
        return self._native.parameters

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Config) and self._native == other._native

    def __hash__(self) -> int:
        return hash(self.to_toml())

    def __reduce__(self) -> tuple[Any, ...]:
        return Config.parse, (self.to_toml(),)

    def __copy__(self) -> Config:
        return self

    def __deepcopy__(self, memo: object) -> Config:
        return self

    def __repr__(self) -> str:
        sections = self.to_dict()
        world, learning = sections["world"], sections["learning"]

        if "agents" in sections:
            agents = ", ".join(f"{group.get('count') or len(group['at'])} × {group['name']}" for group in sections["agents"])
            who = count(self.num_learners, "learner")
        else:
            agents = f"{count(len(world['leaders']), 'leader')}, {count(len(world['followers']), 'follower')}"
            who = learning["paradigm"]
        return (
            f"<flotilla.Config: {agents}, {count(self._native.sizes[1], 'POI')}; {who} by {learning['fitness']}, "
            f"{count(learning['population'], 'team')}, {count(learning['generations'], 'generation')}, "
            f"{count(learning['trials'], 'trial')}, seed {learning['seed']}>"
        )


def check_config(config: Any) -> None:
    """Raises an error if an argument is not a config. A path or a text is a common mistake."""
    if not isinstance(config, Config):
        kind = type(config).__name__
        raise TypeError(f"config is {kind}, but must be a flotilla.Config; see Config.load and Config.paper")


def jitters(config: Config, jitter: float | None, poi_jitter: float | None) -> tuple[float, float]:
    """Returns the jitter of starts and of POIs: as given, or else the config's."""
    learning = config["learning"]
    given = learning["start_jitter"] if jitter is None else jitter
    of_pois = learning["poi_jitter"] if poi_jitter is None else poi_jitter
    return number("jitter", given, 0, 1e9), number("poi_jitter", of_pois, 0, 1e9)

"""The paper's layouts and the constants of an episode, for the peers in Python."""

import math
from dataclasses import dataclass

import numpy as np

MAP = 50.0
DIAGONAL = math.sqrt(2) * MAP
DT = 0.2
MIN_SPEED, MAX_SPEED, MAX_SPEED_CHANGE = 0.0, 3.0, 5 * DT
MAX_TURN = math.pi / 2 * DT
OBSERVATION_RADIUS = 5.0
AGENT_RANGE = 5.0  # POIs are sensed at any distance
ATTRACTION_RADIUS, REPULSION_RADIUS = 5.0, 1.0
ATTRACTION_GAIN, REPULSION_GAIN, WALL_GAIN = 5.0, 1.0, 1.0
INPUTS, HIDDEN, OUTPUTS = 8, 10, 2
WEIGHTS = (INPUTS + 1) * HIDDEN + (HIDDEN + 1) * OUTPUTS
MUTATION_PROBABILITY, MUTATION_SIGMA = 0.15, 0.1
NAMES = ["generally_forward", "strictly_forward", "chaotic"]


@dataclass(frozen=True)
class World:
    starts: np.ndarray  # [agents, 2], leaders first
    pois: np.ndarray  # [pois, 2]
    leaders: int
    coupling: int
    steps: int

    @property
    def agents(self):
        return len(self.starts)

    @property
    def followers(self):
        return self.agents - self.leaders


def make_world(layout, all_leaders=False):
    groups = [10, 40] if layout == "strictly_forward" else [10, 20, 30, 40]
    offsets = [(2, -3), (-2, -3)] + ([(2, 2), (-2, 2)] if layout == "chaotic" else [])
    leaders = [(x, 5) for x in groups]
    followers = [(x + dx, 5 + dy) for x in groups for dx, dy in offsets]
    return World(
        starts=np.array(leaders + followers, np.float32),
        pois=np.array([(x, 15) for x in groups], np.float32),
        leaders=len(leaders + followers) if all_leaders else len(leaders),
        coupling=5 if layout == "chaotic" else 3,
        steps=50 if layout == "chaotic" else 25,
    )

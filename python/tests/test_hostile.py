"""Tests that wrong arguments raise ordinary exceptions and never panic or crash, and that calls leak no memory."""

import gc
import inspect
import os

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import flotilla
from flotilla import Config, VectorEnv

# What a call may raise. A panic becomes PanicException, which is not a subclass of Exception.
ALLOWED = (ValueError, TypeError, KeyError, MemoryError, OverflowError, OSError, flotilla.Error, ImportError)
SMALL = Config(
    world={"leaders": [[5, 5], [9, 5]], "followers": [[4, 3]], "pois": [[5, 9]], "steps": 3},
    learning={"population": 3, "generations": 1, "trials": 1},
)
RUN = flotilla.train(SMALL)
ENV = VectorEnv(SMALL, 4, "Df")
ENV.reset()
# Calls per entry of FUNCTIONS: about 10 000 in total in the short form, and 200 000 in the long one.
EXAMPLES = int(os.environ.get("FLOTILLA_WRONG", "10000" if os.environ.get("FLOTILLA_LONG") else "500"))

numbers = st.one_of(st.integers(), st.integers(-3, 3), st.floats(), st.booleans(), st.complex_numbers())
text = st.one_of(st.text(max_size=20), st.sampled_from(["Df", "cpu", "auto", "", "\0", "..", "chaotic", "\ud800", "-"]))
shapes = st.one_of(
    arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5),
    st.sampled_from([(2, 3, 112), (4, 2, 2), (8,), (1, 1, 112), (4,)]),
)
kinds = st.sampled_from([np.float32, np.float64, np.int64, np.bool_, np.complex64, np.float16, ">f4", "U3", object])


@st.composite
def tensors(draw):
    """Arrays of any shape and type, with extreme numbers, in any memory order."""
    shape, kind = draw(shapes), np.dtype(draw(kinds))
    filled = draw(st.sampled_from([0, 1, -1, 1e30, np.nan, np.inf, -np.inf, 1e-40]))
    with np.errstate(all="ignore"):
        array = np.full(shape, filled if kind.kind in "fcU" else 1, dtype=np.float64).astype(kind)
    return draw(st.sampled_from([lambda a: a, np.asfortranarray, lambda a: a[..., ::-1] if a.ndim else a]))(array)


things = st.recursive(
    st.one_of(
        st.none(), numbers, text, tensors(), st.binary(max_size=8), st.just(object()), st.just(SMALL), st.just(RUN)
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(text, inner, max_size=3), st.tuples(inner, inner)
    ),
    max_leaves=5,
)
# Names of calls, and functions that make them with four arbitrary arguments.
FUNCTIONS = {
    "Config": lambda *a: Config(**{"world": a[0], "learning": a[1]}),
    "Config.parse": Config.parse,
    "Config.load": Config.load,
    "Config.paper": Config.paper,
    "replace": lambda *a: SMALL.replace(world=a[0], learning=a[1]),
    "replace keys": lambda *a: SMALL.replace(learning={"seed": a[0], "fitness": a[1]}, world={"pois": a[2]}),
    "getitem": lambda *a: SMALL[a[0]],
    "rollout": lambda *a: flotilla.rollout(SMALL, a[0]),
    "rollout anything": lambda *a: flotilla.rollout(*a[:2]),
    "rollout starts": lambda *a: (
        flotilla.rollout(SMALL, RUN.policies[0], episodes=a[0], seed=a[1], jitter=a[2])
        if not isinstance(a[0], int) or a[0] < 100
        else None
    ),
    "rollout backend": lambda *a: flotilla.rollout(SMALL, RUN.policies[0], backend=a[0]),
    "score": lambda *a: flotilla.score(SMALL, a[0]),
    "score anything": lambda *a: flotilla.score(*a[:2]),
    "forward": lambda *a: flotilla.forward(*a[:3]),
    "collect": lambda *a: flotilla.collect(SMALL, RUN.policies[0], a[0], a[1], jitter=a[2]),
    "collect anything": lambda *a: flotilla.collect(*a[:4]),
    "train seed": lambda *a: flotilla.train(SMALL, a[0], callback=lambda generation: a[1]),
    "train anything": lambda *a: flotilla.train(a[0]),
    "train backend": lambda *a: flotilla.train(SMALL, backend=a[0]),
    "Run.replay": lambda *a: RUN.replay(*a[:3], team=a[3]),
    "replay": lambda *a: flotilla.replay(SMALL, a[0], a[1]),
    "replay team": lambda *a: flotilla.replay(SMALL, RUN.policies[0], a[0], episodes=1, seed=a[1], jitter=a[2]),
    "plot": lambda *a: flotilla.plot(*a[:2]),
    "compare": lambda *a: flotilla.compare(a[0], at=a[1], reach=a[2], by=a[3]),
    "VectorEnv": lambda *a: VectorEnv(SMALL, a[0] if not isinstance(a[0], int) or a[0] < 1000 else 3, a[1]),
    "VectorEnv.step": lambda *a: ENV.step(a[0]),
    "VectorEnv.reset": lambda *a: ENV.reset(seed=a[0], options={"reset_mask": a[1]} if a[1] is not None else None),
    "native": lambda *a: flotilla._native.rollout(*a[:4]),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_wrong_arguments_raise_ordinary_exceptions(name):
    raised = []

    health_checks = list(HealthCheck)

    @settings(
        max_examples=EXAMPLES, deadline=None, database=None, suppress_health_check=health_checks, derandomize=True
    )
    @given(st.tuples(things, things, things, things))
    def call(arguments):
        try:
            FUNCTIONS[name](*arguments)
        except ALLOWED as error:
            raised.append(error)
            assert "panicked" not in str(error) and "unwrap" not in str(error)

    call()
    assert raised


def test_every_public_function_is_called_or_exempt():
    # These take the same arguments as functions that are called here, or start the program, which has its own tests.
    exempt = {"devices", "paper", "parallel_env", "sweep", "team_env", "to_onnx", "verify"}
    public = {name for name in flotilla.__all__ if inspect.isfunction(getattr(flotilla, name))}
    assert public - exempt <= {name.split()[0] for name in FUNCTIONS}, public - exempt


def memory() -> int:
    """Returns the resident memory of this process, in bytes."""
    gc.collect()
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="only Linux has /proc/self/statm")
@pytest.mark.parametrize("function", ["step", "train", "rollout"])
def test_repeated_calls_leak_no_memory(function):
    env, actions = VectorEnv(Config.paper(), 100, "Df"), np.ones((100, 4, 2), np.float32)
    env.reset()
    config = SMALL.replace(learning={"generations": 2})
    policies = np.zeros((1, 200, SMALL.parameters), np.float32)
    call = {
        "step": lambda: env.step(actions),
        "train": lambda: flotilla.train(config, backend="cpu", callback=lambda generation: None),
        "rollout": lambda: flotilla.rollout(SMALL, policies, trace=True),
    }[function]
    times = {"step": 10_000, "train": 1000, "rollout": 1000}[function]
    # Warm up: the first calls allocate buffers that are kept.
    for _ in range(times // 5):
        call()
    before = memory()
    for _ in range(times):
        call()
    assert memory() - before < 4 << 20

"""What holds for every test: types are checked as the code runs, randomness is seeded, programs are compiled once.

Single precision stays on, as in the product, so a test sees the rounding a user sees.
"""

import atexit
import ctypes
import gc
import os
import resource
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import jaxtyping
import numpy as np
import pytest
from jaxtyping import install_import_hook
from threadpoolctl import threadpool_limits

ROOT = Path(__file__).parent.parent
WITH_ARRAYS = [path for path in (ROOT / "doedesign").rglob("*.py") if "jaxtyping" in path.read_text("utf-8")]

# Whoever starts the tests in the background lets them ignore these, and with them every process that a test starts and
# ends by a signal.
for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) == signal.SIG_IGN:
        signal.signal(number, usual)

# Every core has tests to run: threads that share a small product would only wait for each other, here and in children.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
threadpool_limits(1)

# Programs are compiled once for all processes of a session: those of xdist, which find the name here, and those that
# tests start. It must be said before anything imports jax.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    compiled = tempfile.mkdtemp(prefix="doedesign-compiled-")
    atexit.register(shutil.rmtree, compiled, ignore_errors=True)
    os.environ |= {"JAX_COMPILATION_CACHE_DIR": compiled, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}

# Before any test imports them: from here on the annotations of all modules with arrays are checked at every call,
# shapes included. (The specs are left to pydantic.) As everywhere in Python, an int may stand for a float.
install_import_hook(
    [
        "sim",
        "doedesign.recon",
        "doedesign.training",
        *(".".join(path.relative_to(ROOT).with_suffix("").parts) for path in WITH_ARRAYS),
    ],
    "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))",
)

# The same examples in every run, and no clock: a busy machine must not turn a right answer into a failure.
hypothesis.settings.register_profile(
    "repeatable",
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("repeatable")


def pytest_configure(config: pytest.Config) -> None:
    """Compile without optimisation where long tests are left out: most programs run once there.

    The long tests run the code that users run; `test_long_tests_run_what_users_run` holds this.
    """
    if "not slow" in config.option.markexpr:
        flags = [os.environ.get("XLA_FLAGS", ""), "--xla_backend_optimization_level=0"]
        flags += ["--xla_llvm_disable_expensive_passes=true", "--xla_cpu_use_fusion_emitters=false"]
        os.environ["XLA_FLAGS"] = " ".join(flags).strip()


# Above this, a test process forgets the programs it compiled when a module of tests is done; jax itself never does.
RESIDENT_BYTES = 2.5e9
# By so much it may grow from test to test before pictures are looked for that nothing holds but themselves.
GROWTH_BYTES = 0.2e9
COLLECTED = pytest.StashKey[float]()  # resident bytes after the last search


def resident_bytes() -> int:
    """Memory of this process, or 0 where the system does not say."""
    pages = Path("/proc/self/statm")
    return int(pages.read_text().split()[1]) * resource.getpagesize() if pages.exists() else 0


def pytest_collection_finish() -> None:
    """Leave what the modules hold out of every later search for garbage, which takes a second with it."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
    """Keep the memory of a test process modest."""
    yield
    now = resident_bytes()
    module_is_done = nextitem is None or nextitem.path != item.path
    forgets = module_is_done and now > RESIDENT_BYTES and "jax" in sys.modules
    if forgets:
        sys.modules["jax"].clear_caches()
    if forgets or now > max(RESIDENT_BYTES, item.config.stash.get(COLLECTED, 0.0) + GROWTH_BYTES):
        gc.collect()
        getattr(ctypes.CDLL(None), "malloc_trim", lambda _: 0)(0)
        item.config.stash[COLLECTED] = resident_bytes()


@pytest.fixture
def annotations_unchecked() -> Iterator[None]:
    """As for users, no argument is refused for its annotation: what refuses it is the code."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator that starts the same in every test."""
    return np.random.default_rng(20260)

"""Several devices and several hosts: the steps of one, to rounding, and one of them writes."""

import json
import os
import signal
import socket
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from PIL import Image

from doedesign.capture.images import sample_files
from doedesign.recon.weights import read_network
from doedesign.training import joint as train
from doedesign.training.history import read_history
from doedesign.training.hosts import join_hosts
from fab.errors import InputError
from fab.files import read_json
from fab.pictures import read_display
from tests.doedesign.small_runs import finished_run
from tests.recon.small_training import PLAIN, SPEC, batch, heights, trainer

ROOT = Path(__file__).parents[2]

# --- two devices in one process --------------------------------------------------------------------------------------

DEVICES = f"""
import json, logging
import jax, numpy as np
from doedesign.training.joint import devices_mesh
from tests.recon.small_training import batch, heights, trainer

compiled = []
class Count(logging.Handler):
    def emit(self, record):
        compiled.append("Compiling jit(_take)" in record.getMessage())
logging.getLogger("jax").addHandler(Count())
logging.getLogger("jax").propagate = False
jax.config.update("jax_log_compiles", True)

found = []
for mesh in (None, devices_mesh()):
    made = trainer(*{PLAIN}, "train.batch=2", 'train.field="random"', mesh=mesh)
    state, losses, moments = made.initial(heights()), [], []
    for step in range(2):
        state, line = made.step(state, batch(2, step))
        losses.append(line["loss"])
        moments.append([np.array(leaf, np.float64) for leaf in jax.tree.leaves((state.network_moments.mu,
                       state.optics_moments.mu))])
    picture = made.reconstruct(state, batch(1, 9))[1]
    places = [len(leaf.devices()) for leaf in (state.free, picture)]
    found.append((losses, moments, places, np.asarray(picture)))
alone, shared = found
off = [max(np.linalg.norm(a - b) / max(np.linalg.norm(a), 1e-12) for a, b in zip(*pair))
       for pair in zip(alone[1], shared[1])]
print(json.dumps({{"alone": alone[0], "shared": shared[0], "off": off, "places": [alone[2], shared[2]],
                  "compiled": sum(compiled), "picture": float(np.abs(alone[3] - shared[3]).max())}}))
"""


@pytest.mark.slow
def test_two_devices_take_the_step_of_one() -> None:
    settings = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(DEVICES)],
        check=False,
        cwd=ROOT,
        env=os.environ | settings,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    # Not to the bit: each device adds up the gradients of its own scenes before they are averaged.
    np.testing.assert_allclose(found["shared"], found["alone"], rtol=1e-5)
    assert found["off"][0] < 1e-4
    # Where a gradient is next to nothing, Adam makes a whole step of its rounding: the second step begins elsewhere.
    assert found["off"][1] < 1e-2
    assert found["places"] == [[1, 1], [2, 1]]
    assert found["compiled"] == 2  # once for each of both
    assert found["picture"] < 1e-3


# --- two processes ---------------------------------------------------------------------------------------------------

HOST = """
import os, sys
from fab.files import write_atomic
import doedesign.training.job as job
from doedesign.cli import main

out, written = sys.argv[3], []
def audit(event, args):
    writes = event == "open" and isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR)
    if (writes or event in ("os.rename", "os.remove", "os.mkdir")) and str(args[0]).startswith(out):
        written.append(str(args[0]))
sys.addaudithook(audit)
for name in ("plot_training", "plot_validation"):
    setattr(job, name, lambda *_: None)
job.save = lambda _, path: write_atomic(path, b"picture")
code = main(["train", sys.argv[1], "--images", sys.argv[2], "--out", out, *sys.argv[4:]])
print("written:", len(written))
sys.exit(code)
"""
CHANGES = ("train.steps=8", "train.batch=2", "train.validation=2", "train.validate_every=8", "train.checkpoint_every=4")


def start(arguments: list[Any], cache: Path) -> subprocess.Popen[str]:
    settings = {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    changes = [word for change in (*PLAIN, *CHANGES) for word in ("--set", change)]
    command = [sys.executable, "-c", textwrap.dedent(HOST), *map(str, arguments), *changes]
    return subprocess.Popen(
        command, cwd=ROOT, env=os.environ | settings, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def start_both(arguments: list[Any], cache: Path) -> list[subprocess.Popen[str]]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    hosts = ["--coordinator", f"127.0.0.1:{port}", "--hosts", 2, "--host"]
    return [start([*arguments, *hosts, host], cache / str(host)) for host in range(2)]


def ended(processes: list[subprocess.Popen[str]], code: int) -> list[bool]:
    """Whether each wrote anything, when all have ended by themselves."""
    try:
        said = [process.communicate(timeout=300) for process in processes]
    finally:
        for process in processes:
            process.kill()
    for process, (_, error) in zip(processes, said, strict=True):
        assert process.returncode == code, error
        assert "Traceback" not in error
    return ["written: 0" not in out.splitlines() for out, _ in said]


@pytest.mark.study
def test_two_hosts_train_as_one_and_stop_together(tmp_path: Path) -> None:
    run, images = finished_run(tmp_path, SPEC), tmp_path / "images"
    images.mkdir()
    for k, path in enumerate(sample_files()):
        Image.fromarray(read_display(path, 96)[::-1][:64, :64]).save(images / f"{k}.png")
    alone, both = tmp_path / "alone", tmp_path / "both"
    assert ended([start([run, images, alone, "--occlusion", "paper"], tmp_path / "cache")], 0) == [True]

    arguments = [run, images, both, "--occlusion", "paper"]
    processes, history, end = start_both(arguments, tmp_path), both / "history.jsonl", time.monotonic() + 300
    while not (history.exists() and history.read_bytes().count(b"\n") >= 1):
        if any(process.poll() is not None for process in processes) or time.monotonic() > end:
            ended(processes, 130)
        time.sleep(0.005)
    processes[1].send_signal(signal.SIGTERM)  # the one that writes nothing is told to end, and both do
    assert ended(processes, 130) == [True, False]
    done = json.loads(history.read_text().splitlines()[-1])["step"] + 1
    assert read_json(both / "manifest.json")["state"] == "running"

    assert ended(start_both(arguments, tmp_path), 0) == [True, False]
    assert 1 <= done <= 8
    assert {path.name for path in both.iterdir()} == {path.name for path in alone.iterdir()}
    losses = [[line["loss"] for line in read_history(folder / "history.jsonl", 8)] for folder in (alone, both)]
    # Rounding, as with two devices; the last steps see what Adam made of it.
    np.testing.assert_allclose(losses[1], losses[0], rtol=1e-3)
    weights = [read_network(folder / "network.npz")[0].head[0].weights for folder in (alone, both)]
    np.testing.assert_allclose(weights[1], weights[0], atol=2e-4)  # two steps of Adam apart at most
    scores = [read_json(folder / "metrics.json")["reconstruction"]["full"]["psnr"] for folder in (alone, both)]
    assert scores[1] == pytest.approx(scores[0], abs=0.05)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((None, 2, None), "hosts: must be given with a coordinator"),
        ((None, None, 0), "host: must be given with a coordinator"),
        (("10.0.0.1", 2, 0), 'HOST:PORT or "auto"'),
        (("10.0.0.1:99999", 2, 0), 'HOST:PORT or "auto"'),
        (("10.0.0.1:1234", None, 0), "hosts: must be the number of hosts.*nothing"),
        (("10.0.0.1:1234", 2, None), "host: must lie from 0 to 1.*nothing"),
        (("10.0.0.1:1234", 2, 2), "host: must lie from 0 to 1"),
        (("auto", 2, None), "hosts: must be left out with the coordinator auto"),
    ],
)
def test_hosts_that_cannot_be(given: tuple[Any, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        join_hosts(*given)


def test_host_0_listens_on_the_address_it_was_given_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda *arguments, **more: given.append((*arguments, more)))
    join_hosts("127.0.0.1:1234", 2, 0, wait_s=5)
    bound = {"coordinator_bind_address": "127.0.0.1:1234", "initialization_timeout": 5}
    assert given == [("127.0.0.1:1234", 2, 0, bound)]


def test_a_host_that_finds_nobody() -> None:
    """It says so, and does not wait for ever."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, but nobody listens
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(InputError, match=r"all hosts must find each other within 0 s.*refused"):
            join_hosts(address, 2, 1, wait_s=0)


# --- a device that is not here ---------------------------------------------------------------------------------------


class _TakenError(Exception):
    """The step would begin now."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes", [(), pytest.param(('train.precision="mixed"', "train.checkpointing=true"), marks=pytest.mark.slow)]
)
def test_a_step_is_lowered_for_a_gpu(monkeypatch: pytest.MonkeyPatch, changes: tuple[str, ...]) -> None:
    # Nothing in it may be a processor's own: XLA would find out on the machine that has the GPU, and not before.
    given: list[Any] = []

    def stopped(*arguments: Any) -> Any:
        given.extend(arguments)
        raise _TakenError

    made = trainer(*changes)
    state = made.initial(heights())
    monkeypatch.setattr(train, "_update", lambda: stopped)
    with pytest.raises(_TakenError):
        made.step(state, batch())
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")  # where the code asks, it asks for this
    arrays, rest = eqx.partition(given, lambda leaf: isinstance(leaf, jax.Array | np.ndarray))
    step = jax.jit(lambda moving: eqx.filter(train._take(*eqx.combine(moving, rest)), eqx.is_array))
    text = step.trace(arrays).lower(lowering_platforms=("cuda",)).as_text()
    assert "stablehlo.fft" in text
    assert "stablehlo.convolution" in text
    assert not {line for line in text.splitlines() if "custom_call" in line}

"""The order of commands in the help, an example of each, and the groups of their options."""

from collections.abc import Callable, Mapping
from inspect import Parameter as Argument
from inspect import signature
from typing import Annotated, Any, NamedTuple

from cyclopts import Group, Parameter

# In the order of the work.
STAGES = ("Design", "Masks", "Light", "Process", "Network", "Look")


class Listed(NamedTuple):
    """A command in the help.

    Attributes:
        stage: the stage of the work that it belongs to.
        example: how it is called, without `doedesign`.
    """

    stage: str
    example: str


# Stages in their order, and in each the commands in theirs.
COMMANDS: Mapping[str, Listed] = {
    "new": Listed("Design", "new splitter --out my_splitter.toml"),
    "spec": Listed("Design", "spec optics.focal_length"),
    "optimize": Listed("Design", "optimize examples/quick.toml --set optimize.seed=2 --budget 60"),
    "refine": Listed("Design", "refine runs/cell --steps 100"),
    "masks": Listed("Masks", 'masks runs/quick --on-violation fix --patch "0 um, 0 um, 40 um"'),
    "verify": Listed("Masks", "verify masks/quick"),
    "psf": Listed("Light", "psf runs/quick --fabricated --seed 0"),
    "certify": Listed("Light", "certify runs/quick --cells 12 --pieces 0"),
    "simulate": Listed("Light", "simulate runs/quick --obstruction dirt --count 3"),
    "tolerance": Listed("Process", 'tolerance runs/quick --draws 40 --limit "zeroth_order <= 30 %"'),
    "calibrate": Listed("Process", "calibrate runs/quick measurement/measurement.toml"),
    "precompensate": Listed("Process", "precompensate runs/quick --process process-estimate.toml"),
    "train": Listed("Network", "train runs/quick --images photographs"),
    "finetune": Listed("Network", "finetune runs/quick --pairs pairs --steps 500"),
    "reconstruct": Listed("Network", "reconstruct capture.png --beside"),
    "evaluate": Listed("Network", "evaluate runs/quick --table 2 --pairs 24"),
    "runs": Listed("Look", "runs runs masks --json"),
    "show": Listed("Look", "show masks/quick masks"),
    "compare": Listed("Look", "compare runs/quick runs/quick_v2"),
    "report": Listed("Look", "report runs/quick"),
    "doctor": Listed("Look", "doctor"),
}

_STAGES = {name: Group(name, sort_key=place) for place, name in enumerate(STAGES, 1)}
_INPUT, _COMPUTED, _MACHINES, _OUTPUT = (
    Group(name, sort_key=place)
    for place, name in enumerate(("Input", "What is computed", "Where it is computed", "Output"), 1)
)
# By the names of arguments; what is given without a name is input, and all others say what is computed.
_OF_GROUP = (
    (
        _INPUT,
        (
            "allow_code",
            "as_built",
            "far_depth",
            "images",
            "licence",
            "linear",
            "lpips_weights",
            "masks",
            "method",
            "near_depth",
            "order",
            "pairs",
            "pixel",
            "process",
            "psf",
            "robust",
            "set_",
            "terms",
            "test",
            "validation",
            "variation",
            "wafer",
        ),
    ),
    (_MACHINES, ("coordinator", "devices", "host", "hosts", "scheduler", "workers")),
    (
        _OUTPUT,
        (
            "beside",
            "combined_gds",
            "direct_write",
            "json_",
            "kind",
            "mesh_cells",
            "mesh_patch",
            "one_to_one",
            "out",
            "overwrite",
            "patch",
            "plates",
            "png",
            "print_",
            "tensorboard",
        ),
    ),
)
# The same name for something else in one command.
_APART = {
    ("calibrate", "pairs"): _COMPUTED,
    ("refine", "terms"): _COMPUTED,
    ("evaluate", "pairs"): _COMPUTED,
    ("finetune", "validation"): _COMPUTED,
}


def stage_of(name: str) -> Group:
    """Group of commands that a command is listed in.

    Args:
        name: name of the command.
    """
    return _STAGES[COMMANDS[name].stage]


def place_of(name: str) -> int:
    """Place of a command among all.

    Args:
        name: name of the command.
    """
    return list(COMMANDS).index(name)


def example_of(name: str) -> str:
    """The line of the help that shows how a command is called.

    Args:
        name: name of the command.
    """
    return f"Example: `doedesign {COMMANDS[name].example}`"


def with_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Give the options of a command their groups in the help; returns the command.

    Args:
        command: the function of the command.
    """
    for name, argument in signature(command).parameters.items():
        group = _group_of(command.__name__, argument)
        command.__annotations__[name] = Annotated[argument.annotation, Parameter(group=group)]
    return command


def _group_of(command: str, argument: Argument) -> Any:
    if argument.kind is not Argument.KEYWORD_ONLY:
        return _INPUT
    named = (group for group, names in _OF_GROUP if argument.name in names)
    return _APART.get((command, argument.name)) or next(named, _COMPUTED)

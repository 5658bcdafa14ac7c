"""From a spec to obstruction, sensor and colours, and the files of a capture."""

from pathlib import Path

import numpy as np
import pytest

from doedesign.build import camera_from_spec
from doedesign.capture.camera import depth_range_m
from doedesign.capture.from_spec import (
    channels_from_rgb,
    obstruction_from_spec,
    occlusion_from_spec,
    outside_from_kind,
    plain_parameters,
    require_options,
    rgb_from_channels,
    sensor_from_spec,
)
from doedesign.capture.image_files import read_image, write_image
from doedesign.optimization import optimize
from doedesign.spec import load_spec, scene, spec_digest, spec_from_json, spec_to_json, spec_to_toml
from fab.errors import InputError
from fab.files import canonical_json
from sim.imaging.occlusion import Model
from sim.obstruction import OBSTRUCTIONS, Dirt, DirtRaindrop, DirtRaindropFence, Fence, MaskFolder
from sim.sensor import NoiseModel, Pattern, Sensor

EXAMPLES = Path(__file__).parents[2] / "examples"
AUTOMOTIVE = EXAMPLES / "automotive.toml"
PLAIN = EXAMPLES / "beam_splitter.toml"


def spec_of(*overrides: str, path: Path = AUTOMOTIVE):
    return load_spec(path, overrides)


def test_names_in_a_spec_are_those_of_the_physics():
    assert tuple(OBSTRUCTIONS) == scene.OBSTRUCTION_KINDS
    for names, known in (
        (scene.OCCLUSION_MODELS, Model),
        (scene.NOISE_MODELS, NoiseModel),
        (scene.BAYER_PATTERNS, Pattern),
    ):
        assert set(names) == set(known.__args__)
    for names, literal in ((scene.OCCLUSION_MODELS, scene.Occlusion), (scene.NOISE_MODELS, scene.Noise)):
        assert names == literal.__args__


def test_what_a_spec_does_not_say_leaves_no_trace():
    data = spec_to_json(spec_of(path=PLAIN))
    assert "obstruction" not in data
    assert set(data["scene"]) == {"near_m", "far_m"}
    assert "full_well_e" not in data["sensor"]
    said = spec_of("sensor.full_well=5000", "sensor.quantum_efficiency=0.5", path=PLAIN)
    assert spec_digest(said) != spec_digest(spec_of(path=PLAIN))
    assert spec_from_json(spec_to_json(said), "test") == said
    assert "full_well = 5000" in spec_to_toml(said)


def test_everything_said_reads_back(tmp_path: Path):
    said = spec_of(
        "sensor.quantum_efficiency=[0.4, 0.6, 0.5]", "sensor.bayer=RGGB", "sensor.noise=tseng", "sensor.black_level=64",
        "sensor.dark=2.5", "obstruction.kind=fence", 'obstruction.options={wire="3 mm", depth=["30 cm", "50 cm"]}',
    )  # fmt: skip
    (tmp_path / "spec.toml").write_text(spec_to_toml(said), "utf-8")
    assert load_spec(tmp_path / "spec.toml") == said == spec_from_json(spec_to_json(said), "test")


def test_the_sensor():
    assert sensor_from_spec(spec_of(path=PLAIN)) == Sensor()
    said = spec_of(
        "sensor.full_well=5000", "sensor.bits=10", "sensor.quantum_efficiency=[0.4, 0.6, 0.5]", path=AUTOMOTIVE
    )
    made = sensor_from_spec(said)
    assert (made.full_well_e, made.bits, made.quantum_efficiency) == (5000, 10, (0.4, 0.6, 0.5))
    with pytest.raises(InputError, match="sensor: black_level must lie below 255"):
        sensor_from_spec(spec_of("sensor.bits=8", "sensor.black_level=300"))


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("scene.occlusion=eq10", ["scene.occlusion", "radiometric, reciprocal"]),
        ("sensor.noise=loud", ["sensor.noise", "physical"]),
        ("sensor.bits=17", ["sensor.bits", "at most 16"]),
        ("sensor.full_well=0", ["sensor.full_well", "greater than 0"]),
        ("sensor.read_noise=-1", ["sensor.read_noise", "at least 0"]),
        ("sensor.quantum_efficiency=1.5", ["sensor.quantum_efficiency[0]", "at most 1"]),
        ("sensor.quantum_efficiency=[0.5, 0.4]", ["sensor.quantum_efficiency", "one per colour, 3 here"]),
        ("obstruction.kind=drit", ["obstruction.kind", "Did you mean `dirt`?"]),
        ("obstruction.depth=5 cm", ["obstruction.depth", "known key of [obstruction]"]),
        ("sensor.fullwell=3", ["sensor.fullwell", "Did you mean `full_well`?"]),
    ],
)
def test_mistakes_are_told(override: str, words: list[str]):
    with pytest.raises(InputError) as caught:
        spec_of(override)
    for word in words:
        assert word in str(caught.value)


def test_a_mosaic_needs_three_colours_in_order():
    with pytest.raises(InputError, match=r"sensor\.bayer: a mosaic needs three colours"):
        spec_of("sensor.bayer=RGGB", path=PLAIN)
    with pytest.raises(InputError, match="longest wavelength to the shortest"):
        spec_of("sensor.bayer=RGGB", 'optics.wavelengths=["486 nm", "589 nm", "656 nm"]')


def test_the_occlusion_model_has_no_default():
    assert occlusion_from_spec(spec_of(), "a.toml") == "radiometric"
    assert occlusion_from_spec(spec_of(), "a.toml", "paper") == "paper"
    with pytest.raises(InputError, match=r'a\.toml: scene\.occlusion: .*Give `occlusion`: "reciprocal"'):
        occlusion_from_spec(spec_of(path=PLAIN), "a.toml")
    with pytest.raises(InputError, match=r"occlusion: .*Did you mean `radiometric`"):
        occlusion_from_spec(spec_of(), "a.toml", "radiometrc")


def test_the_obstruction_stands_where_the_plate_was_made_for():
    assert obstruction_from_spec(spec_of(), "a.toml") == Dirt(depth_m=(0.05, 0.12))
    dslr = spec_of(path=EXAMPLES / "dslr.toml")
    assert obstruction_from_spec(dslr, "a.toml") == Fence(depth_m=(0.4, 0.8))
    mixed = obstruction_from_spec(dslr, "a.toml", "dirt_raindrop")
    assert isinstance(mixed, DirtRaindrop)
    assert mixed.dirt.depth_m == mixed.raindrop.depth_m == (0.4, 0.8)
    assert obstruction_from_spec(spec_of("scene.near=[]", path=PLAIN), "a.toml", "dirt") == Dirt()
    assert outside_from_kind(mixed) == outside_from_kind(obstruction_from_spec(dslr, "a.toml", "raindrop")) == "nothing"
    assert outside_from_kind(Dirt()) == "scene"


def test_options_of_a_mixed_kind_name_the_part_that_they_are_for():
    heavy = 'obstruction.options={dirt_clump=["6 mm", "12 mm"], dirt_share=0.2, fence_depth="0.3 m"}'
    made = obstruction_from_spec(spec_of("obstruction.kind=dirt_raindrop_fence", heavy), "a.toml")
    assert isinstance(made, DirtRaindropFence)
    # The fence keeps its own distance; the others stand where the plate was made for.
    assert made.dirt == Dirt(depth_m=(0.05, 0.12), clump_m=(6e-3, 12e-3))
    assert (made.fence.depth_m, made.raindrop.depth_m, made.dirt_share) == ((0.3, 0.3), (0.05, 0.12), 0.2)
    assert depth_range_m(made) == (0.05, 0.3)
    for options, words in (("dirt_clumps=1", "`dirt_clumps`.*dirt_clump`"), ("dirt_share=2", "dirt_share")):
        with pytest.raises(InputError, match=words):
            obstruction_from_spec(
                spec_of("obstruction.kind=dirt_raindrop_fence", f"obstruction.options={{{options}}}"), "a.toml"
            )


def test_options_are_physical_parameters_with_units():
    options = 'obstruction.options={clump=["1 mm", "2 mm"], blur="50 um", octaves=3, depth="7 cm", coverage=[0.2, 0.3]}'
    made = obstruction_from_spec(spec_of(options), "a.toml")
    assert made == Dirt(depth_m=(0.07, 0.07), clump_m=(1e-3, 2e-3), blur_m=(5e-5, 5e-5), octaves=3, coverage=(0.2, 0.3))
    # They are those of the spec's kind; another one named on the command line has its usual ones.
    assert obstruction_from_spec(spec_of(options), "a.toml", "fence") == Fence(depth_m=(0.05, 0.12))
    fence = spec_of("obstruction.kind=fence", 'obstruction.options={tilt=["0 deg", "10 deg"], patterns=["bars"]}')
    made = obstruction_from_spec(fence, "a.toml")
    assert isinstance(made, Fence)
    assert made.tilt_rad == pytest.approx((0, np.radians(10)))
    assert made.patterns == ("bars",)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("{clumps='1 mm'}", ["`clumps`", "Did you mean `clump`?"]),
        ("{clump='1 s'}", ["obstruction.options.clump", "a number with a unit"]),
        ("{clump=3}", ["obstruction.options.clump", "a number with a unit"]),
        ("{coverage=[0.5, 0.1]}", ["obstruction.options.coverage", "the smaller first"]),
        ("{coverage='much'}", ["obstruction.options.coverage", "two numbers", "'much'"]),
        ("{coverage=[0.1, 'much']}", ["obstruction.options.coverage", "two numbers"]),
        ("{coverage=[0.1, 0.2, 0.3]}", ["obstruction.options.coverage", "two numbers"]),
        ("{coverage=[[0.1, 0.2], [0.2, 0.3]]}", ["obstruction.options.coverage", "two numbers"]),
        ("{coverage=true}", ["obstruction.options.coverage", "two numbers"]),
        (
            "{clump='-1 mm'}",
            ["obstruction.options.clump", "two numbers", "to 100 mm, but got -1 mm and -1 mm"],
        ),
        ("{octaves=2.5}", ["obstruction.options.octaves", "a whole number from 1 to 10"]),
        ("{octaves=true}", ["obstruction.options.octaves", "a whole number"]),
        ("{grain=[0.1, 0.2]}", ["obstruction.options.grain", "a number from 0 to 1"]),
        ("{grain='coarse'}", ["obstruction.options.grain", "a number from 0 to 1", "'coarse'"]),
    ],
)
@pytest.mark.usefixtures("annotations_unchecked")
def test_options_that_make_no_sense(options: str, words: list[str]):
    with pytest.raises(InputError) as caught:
        obstruction_from_spec(spec_of(f"obstruction.options={options}"), "a.toml")
    for word in ["a.toml", *words]:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("{dirt_clump='3 km'}", "obstruction.options.dirt_clump: must be two numbers"),
        ("{dirt_clump='3 s'}", "obstruction.options.dirt_clump: must be a number with a unit"),
        ("{dirt_clumps='3 mm'}", "`dirt_clumps`. Did you mean `dirt_clump`?"),
    ],
)
def test_options_of_a_part_that_make_no_sense_are_named_as_they_are_written(options: str, words: str):
    with pytest.raises(InputError) as caught:
        obstruction_from_spec(spec_of("obstruction.kind=dirt_raindrop", f"obstruction.options={options}"), "a.toml")
    assert words in str(caught.value)


def test_options_that_make_no_sense_are_told_before_a_design_is_optimised():
    with pytest.raises(InputError, match=r"obstruction\.options\.clump: must be two numbers"):
        optimize(spec_of('obstruction.options={clump="3 km"}'))
    # A design depends on no masks, which may be elsewhere.
    require_options(spec_of("obstruction.kind=folder", 'obstruction.options={folder="elsewhere"}'), "a.toml")


def test_a_folder_of_masks(tmp_path: Path):
    from PIL import Image

    (tmp_path / "masks").mkdir()
    values = np.zeros((20, 20), np.uint8)
    values[5:10] = 255
    Image.fromarray(values).save(tmp_path / "masks" / "bar.png")
    spec = spec_of("obstruction.kind=folder", 'obstruction.options={folder="masks", width="5 cm"}')
    made = obstruction_from_spec(spec, str(tmp_path / "a.toml"))
    assert isinstance(made, MaskFolder)
    assert (made.width_m, made.depth_m) == (0.05, (0.05, 0.12))
    (tmp_path / "masks" / "bar.json").write_text('{"width_m": 0.04}')
    assert isinstance(obstruction_from_spec(spec_of(), "a.toml", str(tmp_path / "masks")), MaskFolder)
    said = spec_of("obstruction.kind=folder", 'obstruction.options={folder="masks", on_skip="print"}')
    with pytest.raises(InputError, match="on_skip"):  # a function of Python alone
        obstruction_from_spec(said, str(tmp_path / "a.toml"))
    with pytest.raises(InputError, match="kind of obstruction, or a folder"):
        obstruction_from_spec(spec_of(), "a.toml", str(tmp_path / "none"))
    with pytest.raises(InputError, match="folder"):
        obstruction_from_spec(spec_of("obstruction.kind=folder"), "a.toml")
    with pytest.raises(InputError, match="an obstruction must be named"):
        obstruction_from_spec(spec_of(path=PLAIN), "a.toml")


def test_masks_are_known_by_what_their_files_hold(tmp_path: Path):
    from PIL import Image

    def write(name: str, covered: int) -> None:
        values = np.zeros((20, 20), np.uint8)
        values[:covered] = 255
        Image.fromarray(values).save(tmp_path / name)

    def known() -> bytes:
        return canonical_json(plain_parameters(MaskFolder(tmp_path, width_m=5e-3)))

    write("a.png", 5)
    write("b.png", 10)
    first = known()
    assert known() == first
    write("a.png", 10)
    write("b.png", 5)
    exchanged = known()
    (tmp_path / "a.json").write_text('{"width_m": 0.004}')
    assert len({first, exchanged, known()}) == 3
    (tmp_path / "notes.txt").write_text("not looked at")
    (tmp_path / "a.json").unlink()
    assert known() == exchanged


def test_colours_of_a_picture_in_those_of_a_camera():
    light = np.stack([np.full((2, 3), value, np.float32) for value in (0.1, 0.5, 0.9)])
    camera = camera_from_spec(spec_of())
    assert np.array_equal(channels_from_rgb(light, camera), light)
    turned = camera_from_spec(spec_of('optics.wavelengths=["486 nm", "656 nm", "589 nm"]'))
    seen = channels_from_rgb(light, turned)
    assert seen[:, 0, 0] == pytest.approx([0.9, 0.1, 0.5])
    assert np.array_equal(rgb_from_channels(seen, turned), light)
    single = camera_from_spec(spec_of('optics.wavelengths=["550 nm"]'))
    assert channels_from_rgb(light, single)[0, 0, 0] == pytest.approx(0.2126 * 0.1 + 0.7152 * 0.5 + 0.0722 * 0.9)
    assert rgb_from_channels(channels_from_rgb(light, single), single).shape == (3, 2, 3)
    with pytest.raises(InputError, match="three colours, or of one"):
        channels_from_rgb(light, camera_from_spec(spec_of('optics.wavelengths=["550 nm", "600 nm"]')))


@pytest.mark.parametrize("png", [False, True])
def test_files_of_a_capture(tmp_path: Path, png: bool):
    image = np.random.default_rng(0).uniform(0, 1.2, (3, 5, 7)).astype(np.float32)
    stored = write_image(tmp_path, "light", image, ("R", "G", "B"), "light", png=png, full_scale=1.25)
    assert canonical_json(stored)
    again = read_image(tmp_path, stored)
    # Half a count of 16 bits, where there are counts.
    assert again == pytest.approx(image, abs=1.25 / 65535 / 1.99 if png else 0)
    depth = np.array([[[0.05, np.inf], [7.0, 0.05]]], np.float32)
    stored = write_image(tmp_path, "z", depth, ("Z",), "metres", png=png, full_scale=20.0, inverse=png)
    assert read_image(tmp_path, stored) == pytest.approx(depth, rel=1e-2 if png else 0)
    path = tmp_path / stored["file"]
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(InputError, match=path.name):
        read_image(tmp_path, stored)

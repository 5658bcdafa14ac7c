"""Measurements: a TOML file that names the images of a point source and says how they were taken.

    probe = "520 nm"            # wavelength of the source
    pixel = "1.85 um"           # pixel pitch of the images
    gain = 2.1                  # electrons per count
    read_noise = 2.5            # electrons

    [[image]]
    depth = "10 cm"             # of the source, from the plate; "inf" for a collimated beam
    files = ["near_1ms.tiff", "near_10ms.tiff"]
    exposures = ["1 ms", "10 ms"]
    dark = ["dark_1ms.tiff", "dark_10ms.tiff"]

    [[image]]
    depth = "5 m"
    files = ["far.exr"]

Files are found relative to the folder of the TOML file. What a lab may say besides is in `MeasurementSpec` and
`ImageSpec`. `read_measurement` reads the files, merges the exposures and looks for the light.
"""

import logging
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field

from doedesign.calibration.geometry import USUAL_SIGMA, GeometryPrior
from doedesign.calibration.target import MeasuredImage
from doedesign.spec import read_toml, spec_error
from doedesign.spec.errors import validated
from doedesign.spec.values import FarDepth, Pitch, Positive, Wavelength, bounded, broken, length, share
from doedesign.spec.values.table import SpecTable
from fab.errors import InputError
from fab.files import sha256_file
from fab.units import MM, UM, format_length
from sim.camera import Camera
from sim.frames import CameraFrame, Channel, read_frame
from sim.measured import MeasuredPsf, Noise, centre_of_light, cut_window, merge_exposures, without_background

log = logging.getLogger("doedesign")

_TIME = re.compile(r"\s*(\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+)\s*(s|ms|us|µs|ns)\s*")
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}


def _seconds(value: Any) -> float:
    found = _TIME.fullmatch(value) if isinstance(value, str) else None
    if found:
        # 10 * 1e-3 is 0.01, 3 * 1e-3 is not quite 0.003; fifteen digits give back what was meant.
        seconds = float(f"{float(found[1]) * _SECONDS[found[2]]:.15g}")
        if seconds > 0:
            return seconds
    raise broken('must be a time with its unit, such as "10 ms"', "Use s, ms, us or ns.")


Exposure = Annotated[float, BeforeValidator(_seconds)]
Share = Annotated[float, Field(strict=True, gt=0, le=1)]
_FEWEST = 16  # pixels per side


class ImageSpec(SpecTable, frozen=True):
    """One image: a point source at one depth.

    Attributes:
        depth_m: distance of the source from the plate.
        files: its exposures.
        exposures: how long each was; may be left out where there is one.
        name: what it is called; the first file's name by default.
        dark: frames without light, one per exposure or one for all.
        dark_frames: how many frames each dark file is the mean of.
        black_level: counts without light where there is no dark frame; what the file says by default.
        centre: row, counted from the top, and column of the chief ray where it is known; looked for by default.
        depth_sigma_m: how well the depth is known.
        incident: counts per second of all light on the clear aperture, where that was measured; without it only the
            image's shape counts.
        incident_sigma: relative standard deviation of `incident`.
    """

    depth_m: FarDepth = Field(examples=['"10 cm"'])
    files: tuple[str, ...] = Field(min_length=1, examples=['["near_1ms.tiff", "near_10ms.tiff"]'])
    exposures: tuple[Exposure, ...] = Field((), examples=['["1 ms", "10 ms"]'])
    name: str = Field("", examples=['"near"'])
    dark: tuple[str, ...] = Field((), examples=['["dark_1ms.tiff", "dark_10ms.tiff"]'])
    dark_frames: Annotated[int, Field(strict=True, ge=1)] = 1
    black_level: Annotated[float, Field(strict=True, ge=0)] | None = Field(None, examples=["64"])
    centre: tuple[float, float] | None = Field(None, examples=["[512.5, 640.0]"])
    depth_sigma_m: Annotated[float, length(0.0, 10.0)] = 0.0
    incident: Positive | None = Field(None, examples=["2.5e7"])
    incident_sigma: Share = 0.02

    @property
    def called(self) -> str:
        """Its name."""
        return self.name or Path(self.files[0]).stem


_TURNED, _STRETCHED, _BENT = math.radians(10), 0.1, 2.0  # the most that a camera is looked for to be off by


class CameraSpec(SpecTable, frozen=True):
    """How the camera stood, as far as it is known (`doedesign.calibration.geometry`).

    What has a standard deviation is looked for; one of 0 says that the value is known. All zeros are an exact bench,
    which costs least.

    Attributes:
        rotation_rad: angle by which the camera is turned from the plate's +x toward its +y.
        rotation_sigma_rad: standard deviation of `rotation`.
        scale_y: share by which more of the light falls on a pixel's height than pixel pitch and focal length say.
        scale_x: the same for a pixel's width.
        scale_sigma: standard deviation of `scale_y` and `scale_x`.
        distortion: number k where light that belongs r from the chief ray lies at r (1 + k r²/d²), d being the lens's
            distance from the sensor; beside the distortion of the design's lens.
        distortion_sigma: standard deviation of `distortion`.
    """

    rotation_rad: Annotated[float, bounded("rad", -_TURNED, _TURNED)] = 0.0
    rotation_sigma_rad: Annotated[float, bounded("rad", 0.0, _TURNED)] = USUAL_SIGMA[0]
    scale_y: Annotated[float, share(-_STRETCHED, _STRETCHED)] = 0.0
    scale_x: Annotated[float, share(-_STRETCHED, _STRETCHED)] = 0.0
    scale_sigma: Annotated[float, share(0.0, _STRETCHED)] = USUAL_SIGMA[1]
    distortion: Annotated[float, share(-_BENT, _BENT)] = 0.0
    distortion_sigma: Annotated[float, share(0.0, _BENT)] = USUAL_SIGMA[3]

    @property
    def prior(self) -> GeometryPrior:
        """The same as values."""
        mean = (self.rotation_rad, self.scale_y, self.scale_x, self.distortion)
        sigma = (self.rotation_sigma_rad, self.scale_sigma, self.scale_sigma, self.distortion_sigma)
        return GeometryPrior(mean, sigma)


class MeasurementSpec(SpecTable, frozen=True):
    """How images were taken.

    Attributes:
        probe_m: vacuum wavelength of the source.
        pixel_m: pixel pitch of the images.
        gain: electrons per count.
        read_noise: electrons, standard deviation of a reading.
        image: the images, `[[image]]` in TOML.
        mode_field_m: diameter of the mode field of a fibre whose tip is the source, at 1/e² of its irradiance: a near
            tip lights the rim of the plate less than its middle. Without it, light on the plate is even.
        collimator_m: focal length of the lens that collimates that light for images at infinity, which is even without.
        window: pixels per side that are compared; by default what the design's window covers, or the images hold.
        fill_factor: side of a pixel's light-sensitive square over its pitch; the design's by default.
        saturation: counts from which a pixel is full; what the files say by default.
        channel: colour to take of pictures in colour and of RAW mosaics.
        allow_8bit: take files of 8 bits per pixel.
        quarter_turns: quarter turns to the left that bring a picture to the plate's axes, +y up and +x to the right as
            seen along the light.
        mirrored: whether it has to be mirrored left to right before that.
        defocus_sigma_m: how well the sensor's distance is known.
        camera: how the camera stood.
    """

    probe_m: Wavelength = Field(examples=['"520 nm"'])
    pixel_m: Pitch = Field(examples=['"1.85 um"'])
    gain: Positive = Field(examples=["2.1"])
    read_noise: Annotated[float, Field(strict=True, ge=0)] = Field(examples=["2.5"])
    image: tuple[ImageSpec, ...] = Field(min_length=1)
    mode_field_m: Annotated[float, length(0.1 * UM, 1 * MM)] | None = Field(None, examples=['"3.5 um"'])
    collimator_m: Annotated[float, length(1 * MM, 10.0)] | None = Field(None, examples=['"100 mm"'])
    window: Annotated[int, Field(strict=True, ge=_FEWEST, le=8192)] | None = Field(None, examples=["256"])
    fill_factor: Share | None = Field(None, examples=["0.9"])
    saturation: Positive | None = Field(None, examples=["4095"])
    channel: Channel | None = None
    allow_8bit: bool = False
    quarter_turns: Literal[0, 1, 2, 3] = 0
    mirrored: bool = False
    defocus_sigma_m: Annotated[float, length(0.0, 10 * MM)] = 0.0
    camera: CameraSpec = CameraSpec()

    def beam_radius_m(self, depth_m: float) -> float:
        """Radius of the light on the plate at 1/e² of the irradiance in its middle, for a source at a depth.

        That far from a fibre, light spreads like that of a point (`least_depth_m`).
        """
        path_m = depth_m if math.isfinite(depth_m) else self.collimator_m
        if self.mode_field_m is None or path_m is None:
            return math.inf
        return path_m * 2 * self.probe_m / (math.pi * self.mode_field_m)

    @property
    def least_depth_m(self) -> float:
        """Depth from which a fibre's light is that of a point to a thousandth of its curvature: 30 Rayleigh lengths."""
        return 30 * math.pi * ((self.mode_field_m or 0.0) / 2) ** 2 / self.probe_m


class Measurement(NamedTuple):
    """A measurement that was read.

    Attributes:
        window: pixels per side to compare.
        digests: SHA-256 of every file by its name in the TOML file, and of that.
        full: unusable pixels, by image: full in every exposure, or of another colour.
    """

    spec: MeasurementSpec
    images: tuple[MeasuredImage, ...]
    window: int
    digests: dict[str, str]
    full: dict[str, int]


def load_measurement(path: Path) -> MeasurementSpec:
    """Read the TOML file of a measurement; no image is opened.

    Raises:
        InputError: the file cannot be read, is no TOML, or breaks a rule.
    """
    raw = read_toml(path, "a measurement", "the one at the head of doedesign/calibration/measurement.py")
    spec = validated(MeasurementSpec, raw, str(path))
    if problems := list(_problems(spec)):
        raise spec_error(str(path), problems)
    return spec


def _problems(spec: MeasurementSpec) -> Iterator[InputError]:
    if spec.collimator_m is not None and spec.mode_field_m is None:
        cure = 'Add mode_field = "3.5 um", or leave it out.'
        yield InputError("collimator", "goes with a mode_field", format_length(spec.collimator_m), cure)
    names = [image.called for image in spec.image]
    for i, image in enumerate(spec.image):
        key, count = f"image[{i}]", len(image.files)
        if image.depth_m < spec.least_depth_m:
            least, field = format_length(spec.least_depth_m), format_length(spec.mode_field_m or 0.0)
            rule = f"must be at least {least}, where the light of a mode field of {field} spreads like that of a point"
            yield InputError(f"{key}.depth", rule, format_length(image.depth_m), "Correct depth or mode_field.")
        if len(image.exposures) != count and not (count == 1 and not image.exposures):
            rule = f"must have one entry per file, {count} here"
            yield InputError(f"{key}.exposures", rule, str(len(image.exposures)), "Add or remove exposures.")
        if len(image.dark) not in (0, 1, count):
            rule = f"must name one dark frame per file, {count} here, or one for all"
            yield InputError(f"{key}.dark", rule, str(len(image.dark)), "Add or remove files.")
        if image.dark and image.black_level is not None:
            yield InputError(f"{key}.black_level", "must be left out beside `dark`", "both", "Remove one.")
        if names.index(image.called) != i:
            rule, cure = "every image must have its own name", "Add `name` to one of them."
            yield InputError(f"{key}.name", rule, f'"{image.called}" twice', cure)
        if image.incident is not None and not image.exposures:
            rule = "counts per second mean nothing without an exposure"
            yield InputError(f"{key}.exposures", rule, "none", 'Add `exposures = ["10 ms"]`.')


def read_measurement(path: Path, camera: Camera) -> Measurement:
    """Read a measurement with all its images; the window is that of the design's camera unless it says otherwise.

    Raises:
        InputError: a mistake in the file, or an image that cannot be used.
    """
    if camera.in_angles:
        cure = "Give the spec a sensor.distance, or optics.focal_length, and sensor.pitch."
        raise InputError("sensor.pixel_angle", "images are measured with a sensor", camera.lens_text, cure)
    spec = load_measurement(path)
    digests = {path.name: sha256_file(path)}

    def read(name: str) -> CameraFrame:
        log.info(f"reading {name}")
        file = path.parent / name
        digests[name] = sha256_file(file)
        frame = read_frame(file, channel=spec.channel, pixel_m=spec.pixel_m, allow_8bit=spec.allow_8bit)
        return frame._replace(counts=_turned(spec, frame.counts), valid=_turned(spec, frame.valid))

    merged = [_merged(path, spec, image, read) for image in spec.image]
    smallest = min(min(psf.rate.shape) for psf in merged)
    window = spec.window or _window_of(path, spec.pixel_m, camera, smallest)
    images, full = [], {}
    for image, psf in zip(spec.image, merged, strict=True):
        try:
            images.append(_measured_image(spec, image, psf, camera, window))
        except InputError as error:
            raise InputError(f"{path}: image {image.called}", error.rule, error.got, error.cure) from error
        full[image.called] = int((~psf.valid).sum())
        if full[image.called] and spec.channel is None:
            log.info(f"{image.called}: {full[image.called]} pixels are full in every exposure and left out")
    return Measurement(spec, tuple(images), window, digests, full)


def _window_of(path: Path, pixel_m: float, camera: Camera, smallest: int) -> int:
    """Pixels of the images per side of the design's window, of which the smallest image may hold fewer."""
    covered = round(camera.window * camera.pixel_m / pixel_m)
    if min(covered, smallest) < _FEWEST:
        rule = f"the images and the design's window must share at least {_FEWEST} pixels per side"
        field = format_length(camera.window * camera.pixel_m)
        got = f"{covered} of {format_length(pixel_m)} in {field}, and {smallest} in the smallest image"
        raise InputError(f"{path}: pixel", rule, got, "Correct the pixel pitch, or give whole frames and a `window`.")
    return min(covered, smallest)


def _turned(spec: MeasurementSpec, picture: np.ndarray) -> np.ndarray:
    """A picture on the plate's axes. Rows count upwards here, so numpy's turn to the left is one to the right."""
    return np.ascontiguousarray(np.rot90(picture[:, ::-1] if spec.mirrored else picture, -spec.quarter_turns))


def _merged(path: Path, spec: MeasurementSpec, image: ImageSpec, read: Callable[[str], CameraFrame]) -> MeasuredPsf:
    frames = [read(name) for name in image.files]
    files = [read(name) for name in image.dark]
    black = image.black_level
    darks = files * (len(frames) if len(files) == 1 else 1) or [f.black if black is None else black for f in frames]
    try:
        return merge_exposures(
            frames,
            image.exposures or (1.0,),
            darks,
            Noise(spec.gain, spec.read_noise),
            clipped_at=spec.saturation,
            dark_count=image.dark_frames,
            names=image.files,
        )
    except InputError as error:  # in the image, or in what the file says of it
        raise InputError(f"{path}: {error.where}", error.rule, error.got, error.cure) from error


def _measured_image(
    spec: MeasurementSpec, image: ImageSpec, psf: MeasuredPsf, camera: Camera, window: int
) -> MeasuredImage:
    clean, _ = without_background(psf)
    stated = image.centre and _stated_centre(spec, image.centre, psf.rate.shape)
    centre = stated or centre_of_light(clean)
    # The rest of the frame has served; half a window to either side is kept for a better centre.
    size = max(window, min(2 * window, *psf.rate.shape))
    cut, rest = cut_window(clean, centre, size)
    bend = image.depth_sigma_m / image.depth_m**2 if math.isfinite(image.depth_m) else 0.0
    return MeasuredImage(
        name=image.called,
        depth_m=image.depth_m,
        psf=cut,
        centre=((size - 1) / 2 + rest[0], (size - 1) / 2 + rest[1]),
        brightness=(image.incident, image.incident_sigma) if image.incident else None,
        defocus_sigma=math.hypot(bend, spec.defocus_sigma_m / camera.sensor_distance_m**2),
        beam_radius_m=spec.beam_radius_m(image.depth_m),
    )


def _stated_centre(spec: MeasurementSpec, centre: tuple[float, float], shape: tuple[int, ...]) -> tuple[float, float]:
    """Row, counted upwards, and column of a chief ray on the plate's axes."""
    # As the picture lies in its file; a quarter turn exchanges rows and columns.
    rows, columns = shape if spec.quarter_turns % 2 == 0 else shape[::-1]
    y, x = (rows - 1) / 2 - centre[0], centre[1] - (columns - 1) / 2
    x = -x if spec.mirrored else x
    for _ in range(spec.quarter_turns):
        y, x = x, -y
    return y + (shape[0] - 1) / 2, x + (shape[1] - 1) / 2

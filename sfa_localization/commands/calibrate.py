# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Write a calibration file: of the lens that a drive shows, or from another tool's file."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfa_localization.bags.settings import TopicNames
from sfa_localization.camera.settings import CameraConfig, LensCalibration, PanoramaConfig
from sfa_localization.commands import options
from sfa_localization.data.errors import CameraError, LocalizationError
from sfa_localization.data.files import require_outputs, write_bytes
from sfa_localization.data.run import Image

if TYPE_CHECKING:
    from sfa_localization.bags.drives import ReadingRecipe
    from sfa_localization.camera.learned_lens import LearnedLens

WRITES = 'with --output a calibration file, with --check an image; else nothing'
EXAMPLES = """\
  calibrate my_garden --check check.png --output camera.yaml
  calibrate image.png --calibration calib_results.txt --mirrored yes --axis down \\
      --check check.png --output camera.yaml
  calibrate --calibration camchain.yaml --output camera.yaml

The lens of a drive is learned from its images and odometry, as `train` does by itself: this command
is for other programs, and to look at it. The check image marks FRONT, LEFT, BACK and RIGHT of the
robot, and below, in the panorama, the horizon; of several cameras, the seams of their panorama.
Correct a file of another tool with --mount-rpy (ROLLxPITCHxYAW, as 0x0x90), --axis and --mirrored.
omnicam_node reads a file by its parameter calibration_file.

models: mirror (Kalibr omni-radtan, OpenCV omnidir, camodocal MEI; of a fisheye with --mirrored no
--axis up), fisheye (Kalibr pinhole-equi, OpenCV and ROS fisheye), ocam (OCamCalib
calib_results.txt; of a mirror with --mirrored yes --axis down), dual_fisheye (two in one image)"""
LENS = ('axis', 'mirrored')
_BAGS = {'.mcap', '.db3', '.bag'}  # beside folders; other files are images


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add bag or images, calibration file, outputs and the mounting of the camera."""
    parser.add_argument(
        'images', nargs='*', type=Path, metavar='BAG', help='a drive, or with --calibration images'
    )
    options.add_topics(parser, 'image', 'odometry')
    parser.add_argument(
        '--calibration',
        type=Path,
        help='OCamCalib calib_results.txt, or the file of camera_info, OpenCV, Kalibr, camodocal, '
        'stella_vslam or ORB-SLAM3',
    )
    parser.add_argument(
        '--radii', type=options.numbers, help='INNERxOUTER (px) beyond which nothing is visible'
    )
    parser.add_argument('--output', type=Path, help='calibration file to write (YAML)')
    parser.add_argument('--check', type=Path, help='image to write, for a check by eye (PNG)')
    options.add_settings(parser, LensCalibration, LENS)
    options.add_settings(parser, CameraConfig, ('mount_rpy',))


def run(arguments: argparse.Namespace) -> int:
    """Calibrate; print the calibration."""
    from sfa_localization.camera import calibration, calibration_files
    from sfa_localization.camera.encodings import encode_png
    from sfa_localization.camera.lens_report import fitting_panorama
    from sfa_localization.camera.panorama import Unwrapper

    outputs = [path for path in (arguments.output, arguments.check) if path]
    require_outputs(outputs, [*arguments.images, arguments.calibration])
    if arguments.output:
        calibration.require_replaceable(arguments.output)
    if arguments.check:
        options.require_kind(arguments.check, '.png')
    if around := _several(arguments):
        return _check_several(arguments, around)
    lens, learned = _lens(arguments)
    mount_rpy = options.settings(CameraConfig, arguments).mount_rpy
    if any(mount_rpy):
        lens = replace(lens, mount_rpy=mount_rpy)
    text = calibration_files.calibration_text(lens)
    images = _images(arguments)
    if images:
        panorama = fitting_panorama(PanoramaConfig(), learned.sees) if learned else PanoramaConfig()
        # Also without --check, to prove that the calibration is usable.
        check = calibration.check_image(images[0], Unwrapper(CameraConfig(), panorama, lens))
        if arguments.check:
            write_bytes(arguments.check, encode_png(check), CameraError)
    elif arguments.check:
        raise LocalizationError('--check needs an image of the camera to draw in')
    if arguments.output:
        write_bytes(arguments.output, text.encode(), CameraError)
    print(text, end='')
    return 0


def _several(arguments: argparse.Namespace) -> ReadingRecipe | None:
    """The recipe for a bag of several cameras that make a panorama; None for other inputs."""
    from sfa_localization.bags.drives import ReadingRecipe
    from sfa_localization.bags.surround_drive import with_cameras

    bags = [path for path in arguments.images if _is_bag(path)]
    if arguments.calibration or _corrections(arguments) or len(bags) != 1:
        return None
    recipe = ReadingRecipe(topics=options.settings(TopicNames, arguments))
    recipe = with_cameras(bags[0], recipe)
    return recipe if recipe.surround else None


def _check_several(arguments: argparse.Namespace, recipe: ReadingRecipe) -> int:
    """Print how several cameras look, and draw their panorama with its seams."""
    from sfa_localization.bags.surround_drive import first_panorama, yaws_of
    from sfa_localization.camera.calibration import check_surround
    from sfa_localization.camera.encodings import encode_png
    from sfa_localization.camera.surround import sentence

    if arguments.output:
        raise LocalizationError(
            '--output: several cameras have their lenses in camera_info, and the model keeps them: '
            'give only --check'
        )
    (bag,) = arguments.images
    yaws = yaws_of(bag, recipe, progress=True)
    recipe = replace(recipe, surround=yaws.corrected(recipe.surround))
    image = check_surround(*first_panorama(bag, recipe))
    if arguments.check:
        write_bytes(arguments.check, encode_png(image), CameraError)
    print(sentence(recipe.surround))
    for text in yaws.sentences('/tf_static says'):
        print(text)
    return 0


def _corrections(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the command line says otherwise than a calibration file."""
    from sfa_localization.camera.calibration import given_radii

    return options.given(LensCalibration, arguments) | given_radii(arguments.radii)


def _is_bag(path: Path) -> bool:
    return path.is_dir() or bool(_BAGS & set(path.suffixes))


def _lens(arguments: argparse.Namespace) -> tuple[LensCalibration, LearnedLens | None]:
    """The lens of the calibration file, or the one that the drive shows."""
    from sfa_localization.bags.drives import ReadingRecipe
    from sfa_localization.bags.lens_drive import lens_of
    from sfa_localization.camera.calibration import described
    from sfa_localization.camera.lens_report import sentence

    given = _corrections(arguments)
    if arguments.calibration:
        return described(arguments.calibration, given), None
    bags = [path for path in arguments.images if _is_bag(path)]
    if len(bags) != 1 or len(arguments.images) > 1:
        raise LocalizationError(
            'give the bag of one drive, with images and odometry: images alone do not show the '
            'lens; or give --calibration FILE'
        )
    if given:
        raise LocalizationError('--axis, --mirrored and --radii correct a file: give --calibration')
    recipe = ReadingRecipe(topics=options.settings(TopicNames, arguments))
    learned = lens_of(bags[0], recipe, progress=True)
    if learned is None:
        raise CameraError(f'{bags[0]}: its images are panoramas already, and need no lens')
    print(sentence(learned), file=sys.stderr)
    return learned.calibration, learned


def _images(arguments: argparse.Namespace) -> Sequence[Image]:
    """The images of files, or the first of a bag."""
    from sfa_localization.bags.reader import Bag
    from sfa_localization.camera.encodings import read_image

    bags = [path for path in arguments.images if _is_bag(path)]
    if not bags:
        return [read_image(path) for path in arguments.images[:1]]
    with Bag(bags[0]) as bag:
        topic = bag.find('image', options.settings(TopicNames, arguments).image)
        return [image for _, image in itertools.islice(bag.images(topic), 1)]

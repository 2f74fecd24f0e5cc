# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Write a calibration file from images, or from another tool's calibration file."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

from sfa_localization.bags.settings import TopicNames
from sfa_localization.camera.settings import (
    CalibrationConfig,
    CameraConfig,
    LensCalibration,
    PanoramaConfig,
)
from sfa_localization.commands import options
from sfa_localization.data.errors import CameraError, LocalizationError
from sfa_localization.data.files import atomic_write, require_outputs
from sfa_localization.data.run import Image

WRITES = 'with --output a calibration file, with --check an image; else nothing'
EXAMPLES = """\
  calibrate my_garden --check check.png --output camera.yaml
  calibrate drive/*.png --check check.png --output camera.yaml
  calibrate image.png --model fisheye --field-of-view 190 --check check.png
  calibrate image.png --calibration calib_results.txt --mirrored yes --axis down \\
      --check check.png --output camera.yaml
  calibrate --calibration camchain.yaml --output camera.yaml

The check image marks FRONT, LEFT, BACK and RIGHT of the robot, and below, in the panorama, the
horizon. Correct directions with --mount-rpy (ROLLxPITCHxYAW, as 0x0x90), --axis and --mirrored, and
the horizon of a mirror with --angle-min and --angle-max: if it lies 5 degrees above its line,
subtract 5 from both. Circles in the image do not determine these angles.
omnicam_node reads the file by its parameter calibration_file.

models: mirror (Kalibr omni-radtan, OpenCV omnidir, camodocal MEI; of a fisheye with --mirrored no
--axis up), fisheye (Kalibr pinhole-equi, OpenCV and ROS fisheye, or from the rim alone), ocam
(OCamCalib calib_results.txt; of a mirror with --mirrored yes --axis down), polar (from images)"""
LENS = ('angle_min', 'angle_max', 'axis', 'mirrored')
_BAGS = {'.mcap', '.db3', '.bag'}  # beside folders; other files are images
_SAMPLES = 8  # images read from a bag


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add images, calibration file, circles, outputs and the mounting of the camera."""
    parser.add_argument(
        'images', nargs='*', type=Path, metavar='IMAGE', help='raw images, or a bag of them'
    )
    options.add_topics(parser, 'image')
    parser.add_argument(
        '--calibration',
        type=Path,
        help='OCamCalib calib_results.txt, or the file of camera_info, OpenCV, Kalibr, camodocal, '
        'stella_vslam or ORB-SLAM3',
    )
    parser.add_argument(
        '--center', type=options.numbers, help='COLUMNxROW of the mirror (px); default: detected'
    )
    parser.add_argument('--radii', type=options.numbers, help='INNERxOUTER (px); default: detected')
    parser.add_argument('--output', type=Path, help='calibration file to write (YAML)')
    parser.add_argument('--check', type=Path, help='image to write, for a check by eye (PNG)')
    options.add_settings(parser, CalibrationConfig)
    options.add_settings(parser, LensCalibration, LENS)
    options.add_settings(parser, CameraConfig, ('mount_rpy',))


def run(arguments: argparse.Namespace) -> int:
    """Calibrate; print the calibration."""
    from sfa_localization.camera import calibration, calibration_files
    from sfa_localization.camera.encodings import encode_png
    from sfa_localization.camera.panorama import Unwrapper

    outputs = [path for path in (arguments.output, arguments.check) if path]
    require_outputs(outputs, [*arguments.images, arguments.calibration])
    if arguments.output:
        calibration.require_replaceable(arguments.output)
    if arguments.check:
        options.require_kind(arguments.check, '.png')
    images = _images(arguments)
    config = options.settings(CalibrationConfig, arguments)
    given = options.given(LensCalibration, arguments)
    given |= calibration.given_circle(arguments.center, arguments.radii)
    lens = calibration.calibrate(images, arguments.calibration, config, given)
    camera = options.settings(CameraConfig, arguments)
    text = calibration_files.calibration_text(lens, camera.mount_rpy)
    if images:
        # Also without --check, to prove that the calibration is usable.
        check = calibration.check_image(images[0], Unwrapper(camera, PanoramaConfig(), lens))
        if arguments.check:
            with atomic_write(arguments.check, CameraError) as file:
                file.write(encode_png(check))
    elif arguments.check:
        raise LocalizationError('--check needs an image of the camera to draw in')
    if arguments.output:
        with atomic_write(arguments.output, CameraError) as file:
            file.write(text.encode())
    print(text, end='')
    where = arguments.check or 'the image that --check CHECK.png writes'
    print(f'look at {where}: does the horizon lie on its line?', file=sys.stderr)
    return 0


def _images(arguments: argparse.Namespace) -> Sequence[Image]:
    """The images of files, or samples from all over a bag."""
    from sfa_localization.bags.reader import Bag
    from sfa_localization.camera.calibration import ImageFiles

    bags = [path for path in arguments.images if path.is_dir() or _BAGS & set(path.suffixes)]
    if not bags:
        return ImageFiles(arguments.images)
    if len(arguments.images) > 1:
        raise LocalizationError('give one bag, or images')
    with Bag(bags[0]) as bag:
        topic = bag.find('image', options.settings(TopicNames, arguments).image)
        every = max(bag.topics[topic].count // _SAMPLES, 1)
        return [image for _, image in itertools.islice(bag.images(topic), 0, None, every)]

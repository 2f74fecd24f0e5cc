# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Hostile inputs of five kinds, and their use: each is read, or rejected by an error of ours.

`KINDS` maps the name of a kind to its class. An input depends on nothing but the generator that it
is made with; `test/benchmarks/fuzz.py` makes thousands in processes with limits.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from bag_formats import (
    Message,
    compress_files,
    drive,
    write_database,
    write_mcap,
    write_ros1,
    write_version,
)
from cylinder_worlds import PLACE_ARCHITECTURE, Spheres, recipe, run_in, wander
from test_calibration_files import CAMERA_INFO, OCAM

from sfa_localization.bags import decoding
from sfa_localization.bags.reader import KINDS as BAG_KINDS
from sfa_localization.bags.reader import Bag
from sfa_localization.bags.recording import METADATA, parse_metadata
from sfa_localization.bags.run_loader import load_run
from sfa_localization.bags.settings import TopicNames
from sfa_localization.camera.calibration_files import read_calibration
from sfa_localization.camera.encodings import ENCODINGS, decode_compressed, decode_image
from sfa_localization.camera.panorama import read_mask
from sfa_localization.camera.settings import CameraConfig
from sfa_localization.config import load_changes, load_settings, render
from sfa_localization.data.array_files import checksum
from sfa_localization.data.errors import LocalizationError
from sfa_localization.data.messages import read_yaw_rate
from sfa_localization.data.plain_yaml import load_yaml
from sfa_localization.features.network_training import ImageSequence, train_network
from sfa_localization.fusion.pose_filter import PoseFilter
from sfa_localization.inspection import inspect
from sfa_localization.localizer import Observer
from sfa_localization.metric.settings import MetricConfig
from sfa_localization.place_model import PlaceModel
from sfa_localization.training import learn_place

try:
    from sfa_localization.nodes import conversions
except ImportError:  # without ROS only the fields that bags have in common with topics are read
    conversions = None

Random = np.random.Generator
NUMBERS = (0.0, -1.0, np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, 1e9 + 1, 2.0**63)
INTEGERS = (0, 1, -1, 127, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)


class Kind(Protocol):
    """One kind of input. `prepare` writes intact ones into a folder, once for all processes."""

    def prepare(self, folder: Path) -> None: ...

    def open(self, folder: Path) -> None:
        """Read what `prepare` wrote."""

    def use(self, random: Random, folder: Path) -> bool:
        """Make an input and use it: True when it was read, False when it was rejected."""


# Changes.


def damaged(data: bytes, random: Random) -> bytes:
    """Bytes after one to six changes."""
    for _ in range(random.integers(1, 7)):
        at = int(random.integers(0, len(data) + 1))
        # Half of the changes near the ends, where headers and indexes are.
        if random.random() < 0.5:
            near = int(random.integers(0, 200))
            at = min(near, len(data)) if random.random() < 0.5 else max(len(data) - near, 0)
        data = CHANGES[random.integers(len(CHANGES))](data, at, random)
    return data


def _flip(data: bytes, at: int, random: Random) -> bytes:
    return (
        data[:at]
        + bytes(b ^ int(random.integers(1, 256)) for b in data[at : at + 1])
        + data[at + 1 :]
    )


def _number(data: bytes, at: int, random: Random) -> bytes:
    size = int(random.choice([1, 2, 4, 8]))
    value = INTEGERS[random.integers(len(INTEGERS))] % 256**size
    order = 'little' if random.random() < 0.7 else 'big'
    return data[:at] + value.to_bytes(size, order) + data[at + size :]


def _repeat(data: bytes, at: int, random: Random) -> bytes:
    size = int(random.integers(1, 400))
    return data[:at] + data[at : at + size] * int(random.choice([2, 3, 50])) + data[at + size :]


def _moved(data: bytes, at: int, random: Random) -> bytes:
    start, size = int(random.integers(0, len(data) + 1)), int(random.integers(1, 400))
    return data[:at] + data[start : start + size] + data[at:]


CHANGES: tuple[Callable[[bytes, int, Random], bytes], ...] = (
    _flip,
    _number,
    _repeat,
    _moved,
    lambda data, at, random: data[:at],
    lambda data, at, random: data[:at] + random.bytes(int(random.integers(1, 60))) + data[at:],
    lambda data, at, random: data[:at] + data[at + int(random.integers(1, 60)) :],
    lambda data, at, random: data[:at] + bytes(60) + data[at + 60 :],
    lambda data, at, random: data[:at] + b'\xff' * 60 + data[at + 60 :],
)


def pick(random: Random, choices: Sequence[Any]) -> Any:
    """One of the choices."""
    return choices[random.integers(len(choices))]


def require_finite(*values: Any) -> None:
    """Fail the input when a result is not finite."""
    assert all(np.isfinite(value).all() for value in values), 'a result is not finite'


# Messages.

TEXTS = (
    '',
    '\0',
    'x' * 100_000,
    '/map',
    'bgr8',
    'mono16',
    'jpeg',
    'bayer_rggb8; png',
    '\U0001f916',
)
IMAGE_TEXTS = (*ENCODINGS, 'BGR8', 'bgr8; jpeg compressed bgr8', 'bayer_x8; jpeg compressed ')


class Messages:
    """Messages whose bytes or fields are wrong, into what the nodes do with them."""

    def prepare(self, folder: Path) -> None:
        drive(folder)
        learned(folder / 'model.npz', 'gp')

    def open(self, folder: Path) -> None:
        self._decode = decoding.Decoder()
        self._intact = {}
        with Bag(folder / 'drive') as bag:
            for channel, _, data in bag.messages(bag.topics):
                self._intact[channel.kind] = data
        self._intact |= _more_messages(self._intact)
        self._model = PlaceModel.load(folder / 'model.npz')

    def use(self, random: Random, folder: Path) -> bool:
        kind = pick(random, sorted(self._intact))
        data = self._intact[kind]
        filtered = _running_filter()
        try:
            if random.random() < 0.5:
                message = self._decode(damaged(data, random), kind, 'cdr')
            else:
                message = altered(self._decode(data, kind, 'cdr'), random)
            self._receive(message, kind.rpartition('/')[2], filtered)
            read = True
        except LocalizationError:
            read = False
        filtered.add_odometry(2_000_000_000, 0.5, 0.1)
        state = filtered.state
        assert state is not None, 'the filter has lost its start'
        require_finite(state.pose, state.covariance)
        return read

    def _receive(self, message: Any, name: str, filtered: PoseFilter) -> None:
        decoding.header_stamp(message)
        if name in ('Image', 'CompressedImage'):
            image = decoding.image_of(message)
            observation = Observer(self._model).observe(1, image)
            require_finite(observation.pose, observation.covariance)
        elif name == 'Imu':
            require_finite(*read_yaw_rate(message))
        elif name == 'TFMessage':
            for transform in message.transforms:
                require_finite(decoding.pose_of(transform))
        elif name in ('PoseStamped', 'TransformStamped'):
            require_finite(decoding.pose_of(message))
        else:
            self._receive_live(message, name, filtered)

    def _receive_live(self, message: Any, name: str, filtered: PoseFilter) -> None:
        """Messages that only nodes read."""
        if conversions is None:
            return
        if name == 'Odometry':
            motion = conversions.read_odometry(message)
            pose = motion.pose.tolist()
            filtered.add_odometry(motion.stamp_ns, *motion.twist, motion.variances, pose)
        elif name == 'PoseWithCovarianceStamped':
            filtered.add_measurement(*conversions.read_pose(message))
            filtered.set_pose(*conversions.read_pose(message))
        elif name == 'QuaternionStamped':
            filtered.add_turned(*conversions.read_turned(message))
        elif name == 'Float64MultiArray':
            filtered.reconfigure(correlation=conversions.read_error_correlation(message))
        else:
            conversions.read_info(message)


def _running_filter() -> PoseFilter:
    """A filter that has started."""
    filtered = PoseFilter()
    for step in range(1, 6):
        filtered.add_odometry(step * 100_000_000, 0.5, 0.1)
        filtered.add_measurement(step * 100_000_000, np.zeros(3), 0.01 * np.eye(3))
    return filtered


def _more_messages(intact: dict[str, bytes]) -> dict[str, bytes]:
    """Serialized messages of types that the drive does not have."""
    store = decoding.typestore(decoding.Stores.ROS2_JAZZY)

    def made(kind: str, **fields: Any) -> tuple[str, bytes]:
        return kind, bytes(store.serialize_cdr(store.types[kind](**fields), kind))

    odometry = store.deserialize_cdr(intact['nav_msgs/msg/Odometry'], 'nav_msgs/msg/Odometry')
    types, header, pose = store.types, odometry.header, odometry.pose
    turn, place = pose.pose.orientation, pose.pose.position
    move = types['geometry_msgs/msg/Transform'](
        translation=types['geometry_msgs/msg/Vector3'](x=place.x, y=place.y, z=0.0), rotation=turn
    )
    moved = types['geometry_msgs/msg/TransformStamped'](
        header=header, child_frame_id='base', transform=move
    )
    layout = types['std_msgs/msg/MultiArrayLayout'](dim=[], data_offset=0)
    image = np.frombuffer(cv2.imencode('.png', np.zeros((12, 72, 3), np.uint8))[1], np.uint8)
    name = 'geometry_msgs/msg/'
    return dict(
        [
            made('sensor_msgs/msg/CompressedImage', header=header, format='png', data=image),
            made('tf2_msgs/msg/TFMessage', transforms=[moved]),
            made(name + 'TransformStamped', header=header, child_frame_id='a', transform=move),
            made(name + 'PoseStamped', header=header, pose=pose.pose),
            made(name + 'PoseWithCovarianceStamped', header=header, pose=pose),
            made(name + 'QuaternionStamped', header=header, quaternion=turn),
            made('std_msgs/msg/Float64MultiArray', layout=layout, data=np.array([0.5, 1.0])),
            made('std_msgs/msg/String', data=json.dumps({'width': 72, 'height': 12})),
        ]
    )


def altered(message: Any, random: Random) -> Any:
    """The message with one to three other fields."""
    for _ in range(random.integers(1, 4)):
        owner = message
        while True:
            names = [item.name for item in dataclasses.fields(owner) if item.name != '__msgtype__']
            name = pick(random, names)
            value = getattr(owner, name)
            if isinstance(value, list) and value and random.random() < 0.8:
                value = pick(random, value)
            if not dataclasses.is_dataclass(value):
                break
            owner = value
        object.__setattr__(owner, name, _other_value(getattr(owner, name), random))
    return message


def _other_value(value: Any, random: Random) -> Any:
    if isinstance(value, str):
        return pick(random, TEXTS + IMAGE_TEXTS)
    if isinstance(value, bool | int):
        return int(pick(random, INTEGERS))
    if isinstance(value, float):
        return pick(random, NUMBERS)
    if isinstance(value, np.ndarray):
        return _other_array(value, random)
    return []


def _other_array(array: np.ndarray, random: Random) -> np.ndarray:
    """An array of the same type, with another length or with other numbers."""
    if random.random() < 0.3 and array.dtype.kind == 'u':
        return np.resize(array, int(random.integers(0, 2 * array.size + 1)))
    other = array.copy()
    if other.size and other.dtype.kind == 'f':
        other.ravel()[random.integers(0, other.size, 3)] = pick(random, NUMBERS)
    elif other.size:
        other.ravel()[:] = np.frombuffer(random.bytes(other.nbytes), other.dtype).reshape(-1)
    return other


# Models.


def learned(path: Path, metric_map: str) -> None:
    """Write a small model."""
    small = recipe()
    metric = MetricConfig(slow_features=6, metric_map=metric_map)
    run = run_in(Spheres.about(1), wander(80, 2, hz=4.0), small.panorama)
    network = train_network(PLACE_ARCHITECTURE, [ImageSequence.of(run)])
    learn_place(network, [run], dataclasses.replace(small, metric=metric)).model.save(path)


JSON_VALUES = (
    None,
    True,
    0,
    -1,
    2**70,
    1e400,
    float('nan'),
    '',
    'x' * 10_000,
    [],
    [[]],
    {},
    [1, 2],
)


class Models:
    """Model files with other bytes, or with other arrays and headers under a right checksum."""

    def prepare(self, folder: Path) -> None:
        for metric_map in ('gp', 'monomials'):
            learned(folder / f'{metric_map}.npz', metric_map)

    def open(self, folder: Path) -> None:
        self._files = [path.read_bytes() for path in sorted(folder.glob('*.npz'))]
        self._arrays = []
        for path in sorted(folder.glob('*.npz')):
            with np.load(path) as arrays:
                self._arrays.append(dict(arrays))

    def use(self, random: Random, folder: Path) -> bool:
        path = folder / 'model.npz'
        which, way = int(random.integers(len(self._files))), random.random()
        if way < 0.2:
            path.write_bytes(damaged(self._files[which], random))
        elif way < 0.4:
            _with_other_members(self._files[which], path, random)
        else:
            arrays = _other_arrays(self._arrays[which], random)
            header = json.loads(str(arrays['header']))
            header['sha256'] = checksum(arrays, header)
            np.savez(path, **{**arrays, 'header': np.array(json.dumps(header))})
        try:
            model = PlaceModel.load(path)
        except LocalizationError as error:
            assert '\n' not in str(error), 'the error has several lines'
            return False
        size = (model.panorama.height, model.panorama.width, 3)
        estimate = model.locate(random.integers(0, 256, size, np.uint8))
        require_finite(estimate.position, estimate.covariance)
        return True


def _with_other_members(data: bytes, path: Path, random: Random) -> None:
    """A whole zip, one of whose members has other bytes."""
    other = path.with_suffix('.zip')
    other.write_bytes(data)
    with zipfile.ZipFile(other) as old, zipfile.ZipFile(path, 'w') as new:
        chosen = pick(random, old.namelist())
        for name in old.namelist():
            member = old.read(name)
            if name == chosen:
                member = damaged(member[:128], random) + member[128:]
            new.writestr(name, member, pick(random, [0, 0, 0, 8]))


def _other_arrays(arrays: dict[str, np.ndarray], random: Random) -> dict[str, np.ndarray]:
    """Arrays of a model after one to three changes of arrays or header."""
    changed = dict(arrays)
    for _ in range(random.integers(1, 4)):
        name = pick(random, sorted(changed))
        if name == 'header' or random.random() < 0.4:
            changed['header'] = np.array(json.dumps(_other_header(changed['header'], random)))
            continue
        changed.pop(name)
        if random.random() < 0.9:
            name = name if random.random() < 0.9 else name + 'x'
            changed[name] = _other_numbers(arrays.get(name, np.zeros(2)), random)
    return changed


def _other_numbers(array: np.ndarray, random: Random) -> np.ndarray:
    way = random.integers(6)
    if way == 0 or array.dtype.kind == 'U':
        return (
            array.astype(pick(random, ['U9', 'f4', 'i8', '?', 'c16']), copy=True)
            if array.dtype.kind != 'U'
            else np.array('x')
        )
    if way == 1:
        return array[..., :-1] if array.ndim else np.zeros(3)
    if way == 2:
        return array.T.copy()
    other = array.copy()
    if way == 3:
        return np.asarray(other * pick(random, [0, -1, 1e-300, 1e12, 1e300]), array.dtype)
    flat = other.reshape(-1)
    count = int(random.integers(1, 5)) if way == 4 else flat.size
    if flat.size:
        with np.errstate(all='ignore'):
            flat[random.integers(0, flat.size, count)] = np.array(pick(random, NUMBERS)).astype(
                array.dtype
            )
    return other


def _other_header(text: np.ndarray, random: Random) -> Any:
    """The header with another value somewhere."""
    header = json.loads(str(text))
    part: Any = header
    while True:
        keys = sorted(part) if isinstance(part, dict) else range(len(part))
        key = pick(random, list(keys))
        if isinstance(part[key], dict | list) and part[key] and random.random() < 0.8:
            part = part[key]
            continue
        part[key] = pick(random, JSON_VALUES)
        return header


# Bags.

BAGS: dict[str, Callable[[Path, list[Message]], object]] = {
    'sqlite3': lambda p, m: write_version(p, m, 5),
    'mcap': lambda p, m: write_mcap(p / 'a.mcap', m),
    'mcap_zstd': lambda p, m: write_mcap(p / 'a.mcap', m, compression='zstd'),
    'mcap_lz4': lambda p, m: write_mcap(p / 'a.mcap', m, compression='lz4'),
    'mcap_bare': lambda p, m: write_mcap(p / 'a.mcap', m, compression=None, index=False),
    'ros1': lambda p, m: write_ros1(p / 'a.bag', m),
    'ros1_lz4': lambda p, m: write_ros1(p / 'a.bag', m, 'lz4'),
    'ros1_bz2': lambda p, m: write_ros1(p / 'a.bag', m, 'bz2'),
    'zstd_file': lambda p, m: (write_database(p / 'a.db3', m), compress_files(p)),
}


class Bags:
    """Bags with damaged files or metadata, into every reading function."""

    def prepare(self, folder: Path) -> None:
        messages = drive(folder)[:60]
        shutil.rmtree(folder / 'drive')
        for name, write in BAGS.items():
            (folder / name).mkdir()
            write(folder / name, messages)

    def open(self, folder: Path) -> None:
        logging.getLogger('sfa_localization').setLevel(logging.CRITICAL)
        self._bags = {name: folder / name for name in BAGS}

    def use(self, random: Random, folder: Path) -> bool:
        bag = Path(shutil.copytree(pick(random, list(self._bags.values())), folder / 'bag'))
        file = pick(random, sorted(bag.iterdir()))
        data = file.read_bytes()
        text = file.name == METADATA and random.random() < 0.5
        file.write_bytes(spoilt(data.decode(), random).encode() if text else damaged(data, random))
        found = [_is_read(lambda read=read: read(bag, folder)) for read in BAG_USES]
        shutil.rmtree(bag)
        return any(found)


def _is_read(read: Callable[[], object]) -> bool:
    try:
        read()
    except LocalizationError as error:
        assert '\n' not in str(error), 'the error has several lines'
        return False
    return True


def _read_streams(path: Path, _: Path) -> None:
    with Bag(path) as bag:
        for kind in BAG_KINDS:
            _is_read(lambda kind=kind: bag.find(kind))
        for _, image in bag.images('/image_raw'):
            assert image.ndim == 3
        require_finite(bag.odometry('/odom').poses, bag.yaw_rate('/imu').omega)


def _load(path: Path, folder: Path) -> None:
    topics = TopicNames(image='/image_raw', odometry='/odom', ground_truth='/ground_truth')
    run = load_run(path, cache=folder / 'cache', topics=topics, want_truth=True)
    require_finite(run.odometry.poses)
    shutil.rmtree(folder / 'cache')


BAG_USES: tuple[Callable[[Path, Path], object], ...] = (
    _read_streams,
    _load,
    lambda path, folder: inspect(path),
)


# YAML.

TOKENS = (
    *('[', ']', '{', '}', '- ', ': ', '? ', '&a ', '*a ', '*a', '<<: ', '"', "'", '|', '>', '#'),
    *('!!python/name:os.system ', '!!int ', '!!binary ', '!!timestamp ', '%YAML 9.9', '---\n'),
    *('2001-99-99', '.nan', '.inf', '1e999', '9' * 5001, '0x' + 'f' * 90, 'true', 'null', '~', '='),
    *('...\n', '\t', '\n', '\0', '\x85', '\ufeff', '\ud7ff', 'é', 'a: 1\n', '  '),
    *('[' * 2000, '{a: ' * 500, '- ' * 2000),
)


class Yaml:
    """Parameter files, calibrations and metadata with other text, into their readers."""

    def prepare(self, folder: Path) -> None:
        write_database(folder / 'a' / 'a.db3', drive(folder)[:20])
        write_version(folder / 'bag', drive(folder / 'again')[:20], 5)

    def open(self, folder: Path) -> None:
        metadata = (folder / 'bag' / METADATA).read_text()
        info = CAMERA_INFO.format(model='plumb_bob', n=5, coefficients='[0.1, 0, 0, 0, 0]')
        changes = 'sfa_node:\n  ros__parameters:\n    model: a.npz\n    map_frame: map\n'
        self._texts = [render(), changes, info, OCAM, metadata, BOMB]

    def use(self, random: Random, folder: Path) -> bool:
        text = spoilt(pick(random, self._texts), random)
        path = folder / 'file.yaml'
        path.write_bytes(text.encode('utf-8', 'surrogatepass'))
        readers: tuple[Callable[[], object], ...] = (
            lambda: load_changes(path),
            lambda: load_settings(path, 'omnicam_node', CameraConfig),
            lambda: read_calibration(path),
        )
        found = [_is_read(read) for read in readers]
        for parse in (load_yaml, parse_metadata):
            try:
                parse(text)
                found.append(True)
            except ValueError as error:
                assert '\n' not in str(error) and len(str(error)) < 1000
        return any(found)


BOMB = 'a: &a [x, x, x, x]\nb: &b [*a, *a, *a, *a]\nc: &c [*b, *b, *b, *b]\nd: [*c, *c, *c]\n'


def spoilt(text: str, random: Random) -> str:
    """Text after one to six changes."""
    for _ in range(random.integers(1, 7)):
        at, size = int(random.integers(0, len(text) + 1)), int(random.integers(0, 30))
        part = text[at : at + size]
        put = pick(random, [pick(random, TOKENS), part * int(random.integers(0, 40)), ''])
        keep = '' if random.random() < 0.5 else part
        text = text[:at] + put + keep + text[at + size :]
    return text


# Images.

FORMATS = {
    'png': [],
    'jpg': [],
    'progressive.jpg': [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
    'bmp': [],
    'ppm': [],
    'pgm': [],
    'tiff': [],
    'jp2': [],
    'hdr': [],
    'ras': [],
    'webp': [cv2.IMWRITE_WEBP_QUALITY, 80],
    'lossless.webp': [cv2.IMWRITE_WEBP_QUALITY, 101],
}


class Images:
    """Image files with other bytes, and raw images of wrong sizes."""

    def prepare(self, folder: Path) -> None:
        image = np.random.default_rng(0).integers(0, 256, (37, 53, 3), np.uint8)
        for name, options in FORMATS.items():
            suffix = '.' + name.rpartition('.')[2]
            gray = image[..., :1] if name == 'pgm' else image
            done, data = cv2.imencode(suffix, gray, options)
            if done:
                (folder / name).write_bytes(data)

    def open(self, folder: Path) -> None:
        self._files = [path.read_bytes() for path in sorted(folder.iterdir())]

    def use(self, random: Random, folder: Path) -> bool:
        if random.random() < 0.2:
            return _is_read(lambda: _decode_raw(random))
        data = damaged(pick(random, self._files), random)
        path = folder / 'mask.png'
        path.write_bytes(data)
        text = pick(random, TEXTS + IMAGE_TEXTS)
        found = _is_read(lambda: decode_compressed(data, text))
        return _is_read(lambda: read_mask(str(path), (53, 37))) or found


def _decode_raw(random: Random) -> None:
    height, width, step = (int(pick(random, [*INTEGERS, 4, 6, 8, 24])) for _ in range(3))
    size = height * step if 0 <= height * step < 10**6 and random.random() < 0.7 else 96
    encoding = pick(random, ENCODINGS if random.random() < 0.9 else TEXTS)
    decode_image(random.bytes(size), height, width, step, encoding, bool(random.integers(2)))


KINDS: dict[str, Callable[[], Kind]] = {
    'messages': Messages,
    'models': Models,
    'bags': Bags,
    'yaml': Yaml,
    'images': Images,
}

# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""Import MDP 3.6, the last release, with later versions of NumPy.

Repaired only during the import, and only where it fails without:
 - MDP reads numpy.typeDict, gone since NumPy 1.24: the same table of names is provided meanwhile;
 - MDP asks inspect.getfullargspec how many arguments eigh takes, which raises since NumPy 1.25:
   the answer is then none, and MDP uses its own wrapper of eigh.
"""

from __future__ import annotations

import importlib
import inspect
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import numpy as np

from sfa_localization.data.errors import ConfigError

logger = logging.getLogger(__name__)


def import_mdp() -> ModuleType:
    """The module mdp, repaired where it does not import by itself.

    Raises ConfigError when it is not installed, or beyond repair.
    """
    try:
        return importlib.import_module('mdp')
    except ImportError as error:
        raise ConfigError(
            f'the engine mdp is not installed ({error}): pip install "sfa_localization[mdp]"'
        ) from None
    except (AttributeError, TypeError) as error:
        logger.info('MDP does not import on NumPy %s: %s', np.__version__, error)
    _unload()
    try:
        with _with_type_names(), _with_lenient_argspec():
            return importlib.import_module('mdp')
    except (AttributeError, TypeError, ImportError) as error:
        _unload()
        raise ConfigError(
            f'MDP does not work with NumPy {np.__version__} ({error}): use the engine rotation'
        ) from None


def _unload() -> None:
    """Remove the modules of MDP that a failed import left behind."""
    for name in [name for name in sys.modules if name == 'mdp' or name.startswith('mdp.')]:
        del sys.modules[name]


@contextmanager
def _with_type_names() -> Iterator[None]:
    """Provide numpy.typeDict, names of scalar types to the types, inside the block."""
    if 'typeDict' in vars(np):
        yield
        return
    logger.info('repaired for MDP: numpy.typeDict')
    vars(np)['typeDict'] = {name: np.dtype(name).type for name in _TYPE_NAMES if _known(name)}
    try:
        yield
    finally:
        del vars(np)['typeDict']


_TYPE_NAMES = ('float16', 'float96', 'float128', 'complex192', 'complex256')


def _known(name: str) -> bool:
    try:
        np.dtype(name)
    except TypeError:
        return False
    return True


@contextmanager
def _with_lenient_argspec() -> Iterator[None]:
    """Let inspect.getfullargspec answer, inside the block, for functions that it cannot read."""
    ask = inspect.getfullargspec

    def answer(func: object) -> inspect.FullArgSpec:
        try:
            return ask(func)
        except TypeError:
            logger.info('repaired for MDP: the arguments of %s', getattr(func, '__name__', ''))
            return inspect.FullArgSpec([], None, None, None, [], None, {})

    inspect.getfullargspec = answer
    try:
        yield
    finally:
        inspect.getfullargspec = ask

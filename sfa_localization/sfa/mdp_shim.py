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
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import numpy as np

from sfa_localization.data.errors import ConfigError


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
    except (AttributeError, TypeError):
        _unload()
    try:
        with _repaired():
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
def _repaired() -> Iterator[None]:
    """Provide numpy.typeDict, and let inspect.getfullargspec answer for any function, inside the
    block.
    """
    ask = inspect.getfullargspec
    lacks = 'typeDict' not in vars(np)

    def answer(func: object) -> inspect.FullArgSpec:
        try:
            return ask(func)
        except TypeError:
            return inspect.FullArgSpec([], None, None, None, [], None, {})

    inspect.getfullargspec = answer
    if lacks:
        names = ('float16', 'float96', 'float128', 'complex192', 'complex256')
        vars(np)['typeDict'] = {name: getattr(np, name) for name in names if hasattr(np, name)}
    try:
        yield
    finally:
        inspect.getfullargspec = ask
        if lacks:
            del vars(np)['typeDict']

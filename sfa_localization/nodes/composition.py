# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""The chain of nodes in one process.

`omnicam_node` hands its panoramas to `sfa_node` as they are: they are not encoded, and messages of
them are made only for other subscribers.
"""

from __future__ import annotations

from typing import Any

from sfa_localization.nodes.ekf_node import EkfNode
from sfa_localization.nodes.lifecycle import LocalizationNode
from sfa_localization.nodes.omnicam_node import OmnicamNode
from sfa_localization.nodes.sfa_node import SfaNode


def chain(**options: Any) -> list[LocalizationNode]:
    """The three nodes with the same options, not started yet. Raises ConfigError."""
    omnicam = OmnicamNode(**options)
    sfa = SfaNode(**options)
    sfa.takes_panoramas = False
    omnicam.hand_over = sfa.receive
    return [omnicam, sfa, EkfNode(**options)]

# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
"""A file is there whole or not at all, whatever happens while it is written."""

import pytest

from sfa_localization.errors import DataError
from sfa_localization.files import whole_file


def test_the_file_is_there_only_in_the_end(tmp_path):
    path = tmp_path / 'new' / 'a.txt'
    with whole_file(path, make_folder=True) as file:
        file.write(b'whole')
        assert not path.exists()
    assert path.read_bytes() == b'whole'
    assert [p.name for p in path.parent.iterdir()] == ['a.txt']
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize('kind', [ValueError, KeyboardInterrupt])
def test_an_error_leaves_what_was_there_and_nothing_else(tmp_path, kind):
    path = tmp_path / 'a.txt'
    path.write_bytes(b'old')
    with pytest.raises(kind), whole_file(path) as file:
        file.write(b'half')
        raise kind
    assert path.read_bytes() == b'old'
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    with (
        pytest.raises(DataError, match=r'missing/a\.txt: cannot be written: No such'),
        whole_file(tmp_path / 'missing' / 'a.txt', DataError),
    ):
        raise AssertionError

"""Names that become files, and values as messages quote them."""

from __future__ import annotations

import pytest

from surefoot.errors import SurefootError, check_name, quoted


@pytest.mark.parametrize("name", ["trot", "gallop-robust", "_1", "A" * 100])
def test_a_plain_name_is_taken(name):
    check_name("name", name)


@pytest.mark.parametrize("name", ["", ".", "..", "../../x", "a/b", "a b", "a.b", "-x", "a\n", "\u00e9", "A" * 101])
def test_what_could_leave_its_folder_or_be_none_is_refused(name):
    with pytest.raises(SurefootError, match=r"^name is .*letters, digits, - and _ only"):
        check_name("name", name)


def test_a_quoted_value_is_short_whatever_it_is():
    bomb: list[object] = ["x"]
    for _ in range(60):
        bomb = [bomb] * 9
    for value in (bomb, {"a": bomb}, "x" * 10**6, 10**4000, list(range(10**5))):
        assert len(quoted(value)) < 300
    assert quoted([0, 1.5, "a"]) == "[0, 1.5, 'a']"

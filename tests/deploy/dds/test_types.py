"""IDL types of a Go2's topics: DDS matches readers and writers by the identifiers of types."""

from __future__ import annotations

import pytest

pytest.importorskip("cyclonedds")

from surefoot.deploy.dds import types


@pytest.mark.parametrize(
    ("name", "identifier"),
    [
        ("LowState", "08f239c471d3a27e67e7c7723184"),
        ("LowCmd", "52cc8eb0d427d692aa2b20a90540"),
        ("SportModeState", "e59749630fff75cc170afb238783"),
        ("Request", "c47a4429fcbf539486498753c48f"),
        ("Response", "d1c32cc02214901a464a6c51325d"),
    ],
)
def test_a_type_has_the_hash_of_the_vendors_idl(name: str, identifier: str):
    # The first 14 bytes of the MD5 of names, kinds and order of all fields, as XTypes 1.3 defines it (7.3.1.2).
    assert bytes(getattr(types, name).__idl__.get_type_id().value).hex() == identifier

"""Damaged logs of the released code; those that are whole are replayed by a fence."""

import numpy as np
import pytest

from ms_highway.experiments.validation import validate_file


def test_damaged_arrays_are_refused_by_name(reference, tmp_path):
    with np.load(reference / "merger__tom.npz") as archive:
        arrays = dict(archive)
    file = tmp_path / "merger__tom.npz"
    for change, message in (
        ({"models": arrays["models"] + 5}, "no places in naive, turn, tom"),
        ({"states": arrays["states"] * 1e300}, "states holds numbers that are not finite"),
    ):
        np.savez(file, **{**arrays, **change})
        with pytest.raises(ValueError, match=message):
            validate_file(file)
    file.write_bytes(b"not an archive")
    with pytest.raises(ValueError, match=r"merger__tom\.npz cannot be read as a reference file"):
        validate_file(file)

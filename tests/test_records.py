"""The values that flow."""

import warnings

import numpy as np
import pytest

from jaxsid.records import Record


def test_single_precision_is_warned_of(single_precision):
    with pytest.warns(UserWarning, match="single precision costs accuracy"):
        Record(np.zeros(4), np.zeros(4), 0.1)


def test_double_precision_is_silent():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        record = Record(np.zeros(4), np.zeros((4, 2)), 0.1)
    assert record.u.shape == (4, 1)
    assert record.outputs == ("output1", "output2")
    assert record.hold == ("zero",)

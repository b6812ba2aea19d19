"""Requests: values of another type than the field's are refused in one line each."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig import requests
from rig.errors import UsageError
from rig.requests import CheckedRequest, ScanRequest, StrategiesRequest

EVERY = [
    each
    for each in vars(requests).values()
    if isinstance(each, type) and issubclass(each, CheckedRequest) and each is not CheckedRequest
]


@pytest.mark.parametrize("request_type", EVERY)
def test_usual_values_are_of_their_types(request_type: type[CheckedRequest]) -> None:
    request_type()


@pytest.mark.parametrize(
    ("values", "lines"),
    [
        ({"rows": "few"}, ["`rows` is 'few'; it must be a whole number"]),
        ({"rows": 2.0}, ["`rows` is 2.0; it must be a whole number"]),
        ({"rows": True}, ["`rows` is True; it must be a whole number"]),
        ({"lux": "dark"}, ["`lux` is 'dark'; it must be a number"]),
        ({"limits": "maybe"}, ["`limits` is 'maybe'; it must be true or false"]),
        ({"lines": ["two"], "fogs": "20m"}, [
            "`fogs` is '20m'; it must be a list of text", "`lines` is ['two']; it must be a list of whole numbers",
        ]),
        ({"out": 3}, ["`out` is 3; it must be text or a path"]),
        ({"error": 0.1}, ["`error` is 0.1; it must be text"]),
    ],
)  # fmt: skip
def test_another_type_is_one_line_for_each_field(values: dict[str, Any], lines: list[str]) -> None:
    with pytest.raises(UsageError) as refused:
        StrategiesRequest(**values)
    assert sorted(refused.value.problems) == lines


def test_numbers_of_numpy_paths_and_tuples_are_taken() -> None:
    StrategiesRequest(rows=np.int32(4), lux=np.float32(2.0), exposures=(np.int64(3),), out=Path("out"), lines=[2])
    ScanRequest(maps=None, min_confidence=1, tags={"fog"}, record=np.bool_(True))  # type: ignore[arg-type]

"""Messages: what they quote of a file is short, whatever it contains."""

import pytest

from tricap.core.foundation.errors import InputError, damage_of


@pytest.mark.parametrize("length", [0, 1, 99, 100, 1000, 10**6])
def test_a_quotation_is_not_endless(length: int) -> None:
    said = str(InputError(f"a.yml lacks the matrix “{'x' * length}”; give “R” or “{'y' * length}”."))
    if length < 100:
        assert "x" * length + "”;" in said and "…" not in said
    else:
        assert said == f"a.yml lacks the matrix “{'x' * 80} …”; give “R” or “{'y' * 80} …”."


def test_what_python_says_of_a_value_is_not_endless_either() -> None:
    with pytest.raises(ValueError, match="could not convert") as error:
        float("x" * 10**6)
    assert len(damage_of(error.value)) < 210 and damage_of(error.value).startswith("could not convert")
    assert damage_of(InputError("y" * 400)) == "y" * 400, "a sentence of ours stays whole"

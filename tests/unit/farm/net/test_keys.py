"""Names in keys: the worker or the run that a key names; keys without a valid name are refused."""

import pytest

from farm.errors import ConfigError, MessageError
from farm.net import keys


def test_the_names_behind_a_prefix() -> None:
    assert keys.worker_in("farm/want/host/12-ab", keys.want("farm", "")) == "host/12-ab"
    assert keys.run_in("farm/live/learner/first", keys.learner_token("farm", "")) == "first"


@pytest.mark.parametrize(
    "behind",
    [
        "",
        "a",
        "a/",
        "/1",
        "a/b/c",
        "a/*",
        "**",
        "a/$*",
        "ä/1",
        f"{'x' * 101}/1",
        "/".join("ab" * 15_000),
        "./1",
    ],
)
def test_a_key_without_a_worker_is_refused(behind: str) -> None:
    with pytest.raises(MessageError, match="a key without a name"):
        keys.worker_in(f"farm/want/{behind}", keys.want("farm", ""))


@pytest.mark.parametrize("behind", ["", "a/b", "*", "x" * 101, "a/" * 10_000])
def test_a_key_without_a_run_is_refused(behind: str) -> None:
    with pytest.raises(MessageError, match="a key without a name"):
        keys.run_in(f"farm/live/learner/{behind}", keys.learner_token("farm", ""))


def test_a_key_of_another_farm_is_refused() -> None:
    with pytest.raises(MessageError, match="a key without a name"):
        keys.worker_in("other/want/a/1", keys.want("farm", ""))


@pytest.mark.parametrize("name", ["", "..", "a b", "a/b", "ä", "x" * 101, "a\n"])
def test_names_that_cannot_be_part_of_a_key(name: str) -> None:
    with pytest.raises(ConfigError, match="is not a name"):
        keys.checked("run", name)

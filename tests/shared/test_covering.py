"""The smaller sample of a product of settings has what it promises."""

import itertools

import pytest
from covering import any_two, covering, product

CHOICES = {
    "shape": ("round", "flat"),
    "size": (1, 2, 3),
    "colour": ("red", "green", "blue"),
    "lid": (True, False),
}


@pytest.mark.parametrize(("strength", "most"), [(1, 3), (2, 10), (3, 22)])
def test_all_values_of_so_many_settings_occur_together(strength, most):
    selection = covering(product(CHOICES), strength)
    for names in itertools.combinations(CHOICES, strength):
        expected = set(itertools.product(*(CHOICES[name] for name in names)))
        assert {tuple(case[name] for name in names) for case in selection} == expected
    assert len(selection) <= most, "of the 36 of the product"


def test_what_no_case_has_is_not_missed():
    cases = [case for case in product(CHOICES) if case["lid"] or case["shape"] == "flat"]
    selection = covering(cases, 2)
    assert all(case in cases for case in selection)
    assert {(case["lid"], case["shape"]) for case in selection} == {
        (True, "round"),
        (True, "flat"),
        (False, "flat"),
    }


def test_the_choice_is_the_same_each_time():
    assert covering(product(CHOICES), 2) == covering(product(CHOICES), 2)


def test_cases_are_in_the_order_of_their_names():
    names, cases = any_two(size=(1, 2), lid=(True, False))
    assert names == ("size", "lid")
    assert sorted(cases) == [(1, False), (1, True), (2, False), (2, True)]

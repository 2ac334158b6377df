"""Objects' files that are no XML, and that MuJoCo loads: the same model as from the file that
is.
"""

import mujoco
import pytest

from farm.errors import ConfigError
from farm.tasks.finger_gait import model
from farm.tasks.finger_gait.markup import tree

STRICT = """<mujoco model="brick"><worldbody><body name="object" pos="0.08 0.04 0.02">
  <freejoint name="object"/><geom name="a" type="box" size="0.011 0.06 0.011" mass="0.05"/>
  <geom name="b &amp; c" type="sphere" size="0.01" pos="0 0.05 0" mass="0.01"/>
</body></worldbody></mujoco>"""
LENIENT = {
    "dashes in a comment": STRICT.replace("<worldbody>", "<!-- 22 -- 120 -- 22 mm --><worldbody>"),
    "no space between attributes": STRICT.replace('" type', '"type'),
    "a bare ampersand": STRICT.replace("&amp;", "&"),
    "an end tag too many": STRICT + "</mujoco>",
    "an empty line first": '\n<?xml version="1.0"?>' + STRICT,
    "two roots": STRICT + STRICT.replace("0.011", "0.022"),
    "a byte order mark": "\ufeff" + STRICT,
    "Latin-1": STRICT.replace("<worldbody>", "<!-- kurz für -->\n<worldbody>"),
}


def compiled(text: str, tmp_path) -> mujoco.MjModel:
    file = tmp_path / "thing.xml"
    file.write_bytes(text.encode("latin-1" if "ü" in text else "utf-8"))
    texts = model.files([str(file)], "opposed")
    return mujoco.MjModel.from_xml_string(model.mjcf(texts))


@pytest.mark.parametrize("kind", LENIENT)
def test_what_mujoco_tolerates_is_the_same_object(kind, tmp_path) -> None:
    if kind != "Latin-1":
        mujoco.MjModel.from_xml_string(LENIENT[kind])
    ours = compiled(LENIENT[kind], tmp_path)
    strict = compiled(STRICT, tmp_path)
    for name in ("geom_size", "geom_pos", "body_mass", "body_inertia", "dof_damping", "jnt_type"):
        assert (getattr(ours, name) == getattr(strict, name)).all()
    assert ours.names == strict.names


@pytest.mark.parametrize("text", ["", "no tags", "<mujoco><worldbody></mujoco>"])
def test_what_is_no_markup_is_one_line(text, tmp_path) -> None:
    with pytest.raises(ValueError, match=r"."):
        tree(text)
    with pytest.raises(ConfigError, match=r"object.xml cannot be read: "):
        compiled(text, tmp_path)

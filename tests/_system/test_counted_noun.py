import pytest

from ssa_nerfstudio._system.counted_noun import counted


@pytest.mark.parametrize(
    ("count", "said"), [(0, "0 photos"), (1, "1 photo"), (2, "2 photos"), (1000, "1,000 photos"), (21, "21 photos")]
)
def test_one_is_singular_alone(count, said):
    assert counted(count, "photo") == said

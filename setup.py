"""Ships configs/ as ssa_nerfstudio/configs, which pyproject.toml alone cannot say; all else is there."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["ssa_nerfstudio*"]), "ssa_nerfstudio.configs"],
    package_dir={"ssa_nerfstudio.configs": "configs"},
    package_data={"ssa_nerfstudio.configs": ["*/*.yaml"]},
)

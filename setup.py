"""Ships configs/ as ssa_nerfstudio/configs, and the templates of pages; pyproject.toml holds all else."""

from setuptools import find_namespace_packages, find_packages, setup

configs = ["ssa_nerfstudio.configs", *(f"ssa_nerfstudio.configs.{kind}" for kind in find_namespace_packages("configs"))]
setup(
    packages=[*find_packages(include=["ssa_nerfstudio*"]), *configs],
    package_dir={"ssa_nerfstudio.configs": "configs"},
    package_data={
        **{name: ["templates/*"] for name in ("ssa_nerfstudio.experiments", "ssa_nerfstudio.workflow")},
        **{name: ["*.yaml"] for name in configs},
    },
)

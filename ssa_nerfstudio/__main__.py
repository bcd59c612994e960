"""`python -m ssa_nerfstudio`: the same as `ssa`."""

from ssa_nerfstudio.cli import main

main()

"""From photos to splats and a report (`ssa run`): what the other commands do, in stages that a stopped run keeps."""

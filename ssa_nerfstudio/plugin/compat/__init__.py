"""What nerfstudio 1.1.5 and gsplat 1.4.0 need repaired: one function per repair, with its reason and when it may go.

Each has a test in tests/plugin/compat that fails on the day upstream no longer needs the repair. Repairs that are an
overridden method are in the class that overrides it:

- `datamanager`: `cache_images="cpu"` pins memory, which needs CUDA.
- `first_view`: the viewer opens at a fixed place of its own (`ViewerControl._setup` is where it can be told another).
- `model.populate_modules`: seed colors are moved to CUDA (splatfacto.py:261).
- `model.load_state_dict`: makes new Parameters after the optimizers exist, so that a resumed run trains nothing
  (splatfacto.py:392).
- `trainer.train`: a resumed run trains `max_num_iterations` more steps instead of up to them.
- `training.densification`: gsplat 1.4.0 resets opacities at step 0, too (`step % reset_every == 0`).
- `training.event_writers`: times, rates and learning rates are written at every step (trainer.py:309).

What the next versions will break:

- gsplat 1.5 and main: `info["radii"]` has two columns ([C, N, 2], one radius per axis), which
  `densification._update_state` reads as one; `info` counts `n_images`, not `n_cameras`; relocation takes
  `min_opacity` from the strategy; `inject_noise_to_position` reads its scaler as a number, which waits for the device
  where `langevin_noise` passes a tensor. 1.5.3 never resets opacities under ADC (operator precedence in
  `strategy/default.py`): do not move to it.
- nerfstudio main: splatfacto has an MCMC option of its own, which `settings.strategy` would shadow.
- torch: `_fused_adam_`, `_foreach_add_` and `_amp_foreach_non_finite_check_and_unscale_` are private
  (`versions.WRITTEN_FOR` bounds the version).
"""

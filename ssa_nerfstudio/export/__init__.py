"""Export of a finished run: the artifact as pictures and masks, photos without it, and the splats."""

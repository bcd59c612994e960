"""What a training learned, as files: the artifact as pictures, photos without it, and the splats."""

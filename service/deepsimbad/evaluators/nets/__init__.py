"""Architectures in plain torch: tensors in, tensors out. Nothing here reads files, resizes images or picks a device."""

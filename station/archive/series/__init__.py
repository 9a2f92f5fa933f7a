"""Series of epochs: index, epoch reader, manifest, virtual file, lazy dataset."""

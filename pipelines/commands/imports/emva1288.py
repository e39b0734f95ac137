"""`faintfield import emva1288`: EMVA 1288 reference data become noise sets."""

import shutil
from pathlib import Path

from faintfield.pipelines.console import inform, progress


def import_emva1288(descriptor: Path, out: Path, /, *, overwrite: bool = False) -> dict[str, str | float]:
    """Make a noise set of EMVA 1288 reference data.

    Parameters
    ----------
    descriptor
        The data's descriptor file; images lie beside it.
    out
        Folder to write: noise.toml and copies of the images.
    overwrite
        Replace an earlier set in OUT.
    """
    import msgspec

    from faintfield.pipelines.formats.exchange.emva1288 import image_path, read_descriptor
    from faintfield.pipelines.formats.files import sha256, write_json, writing_folder
    from faintfield.pipelines.formats.provenance import provenance
    from faintfield.pipelines.formats.sets.noise_set import FILE_NAME, NoiseSet, write_noise_set

    read = read_descriptor(descriptor)
    sources = [image_path(descriptor, frame.file) for frame in read.frames]
    names = [f"frames/{index:05d}_{source.name}" for index, source in enumerate(sources)]
    frames = [msgspec.structs.replace(frame, file=name) for name, frame in zip(names, read.frames, strict=True)]
    saturation_dn = float(2**read.bits - 1)
    replace = FILE_NAME if overwrite else None
    with writing_folder(out, replace_if=replace, reads=[descriptor, *sources]) as folder:
        (folder / "frames").mkdir()
        for source, name in progress(list(zip(sources, names, strict=True)), "copying frames"):
            shutil.copyfile(source, folder / name)
        write_noise_set(folder, NoiseSet(1, frames, saturation_dn))
        inputs = {frame.file: sha256(source) for frame, source in zip(read.frames, sources, strict=True)}
        inputs |= {descriptor.name: sha256(descriptor)}
        write_json(folder / "provenance.json", provenance("import emva1288", {}, inputs))
    inform(f"{out / FILE_NAME}: {len(frames)} frames of EMVA 1288 release {read.release or 'unstated'} data")
    return {"out": str(out), "frames": len(frames), "release": read.release, "saturation_dn": saturation_dn}

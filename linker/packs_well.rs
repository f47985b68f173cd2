/// Additional compiler options for the bootloader, which extend `.cargo/config.toml`. The RAM image
/// of the bootloader is compressed, so the same operation should always give the same code: no
/// outlining of repeated short pieces of code, a register allocator that takes the first free
/// register, and no reordering after it. These options make the bootloader larger in RAM and
/// smaller in flash (found by trial). The resident part is not compressed, but gets the same
/// options, because the compressed image copies from it.
const PACKS_WELL: &str = "-Cllvm-args=--enable-machine-outliner=never --regalloc=basic --disable-post-ra=1";

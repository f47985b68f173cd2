/// What the compiler is told beside `.cargo/config.toml` about the bootloader, whose RAM image is
/// packed: to write the same thing in the same way. No calls in the place of short pieces of code
/// that stand several times, the first register that is free, and no reordering behind that. A
/// bootloader gets larger by that as it runs from RAM, and smaller in flash (found by trial). The
/// resident part, which is not packed, is told the same, since the packed image copies from it.
const PACKS_WELL: &str = "-Cllvm-args=--enable-machine-outliner=never --regalloc=basic --disable-post-ra=1";

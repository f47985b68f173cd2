//! The sealed device as a demonstration: `cargo xtask demo --sealed`.

use canopen::program::{FlashStatus, ProgramControl};
use canopen::AbortCode;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::sealed_board::{key, provision, release, root, sealer, write, COUNTER, KEKS};
use coflash_core::device::Transfers;
use coflash_core::file::sealed::Sealer;

use crate::steps::{chapter, introduce, print_line, Outcome};

/// The board gets its keys; it accepts valid images, and refuses all others.
pub fn run(bench: &mut Bench) -> Outcome<()> {
    chapter("Production: keys go into the bootloader's flash, which makes a sealed device of the board");
    let (root, release) = (root().public().id(), self::release().public().id());
    print_note(&format!("root key {root:08X}h: the device gets its public half"));
    print_note(&format!("release key {release:08X}h, certified by the root: it signs programs"));
    print_note(&format!("key-encryption key {:08X}h: it opens encrypted programs", KEKS[0].id()));
    print_note(&format!("security counter: the device takes none below {COUNTER}"));
    provision(bench);
    bench.power_on();
    print_line(bench.time(), "power on");
    let up = bench.await_boot_up(1000);
    print_line(up, &format!("boot-up of node {NODE}"));
    introduce(bench)?;

    chapter("Version 1 is sealed, and goes into the board");
    install(bench, firmware::APP_V1, &sealer(COUNTER))?;

    let v2 = firmware::raw(firmware::APP_V2);
    let genuine = sealer(COUNTER).seal(&v2, &self::release())?;
    let mut flipped = genuine.clone();
    // In the image, whose hash the signature covers.
    flipped[50] ^= 1;
    chapter("Somebody sends version 2 with one bit flipped");
    refuse(bench, &flipped)?;
    chapter("Somebody sends a version 2 whose security counter is too low");
    refuse(bench, &sealer(COUNTER - 1).seal(&v2, &self::release())?)?;
    chapter("Somebody sends a version 2 that was signed by a key which the device does not know");
    refuse(bench, &Sealer { certificate: None, ..sealer(COUNTER) }.seal(&v2, &key(9))?)?;
    chapter("Somebody sends version 2 without a seal");
    refuse(bench, &v2)?;

    chapter("Version 2 is sealed, compressed and encrypted, with a higher counter, and goes into the board");
    install(bench, firmware::APP_V2, &Sealer { compress: true, encrypt_for: &*KEKS, ..sealer(COUNTER + 1) })?;

    chapter("Somebody sends version 1 as it was sealed at first: there is no way back");
    refuse(bench, &sealer(COUNTER).seal(&firmware::raw(firmware::APP_V1), &self::release())?)?;
    bench.assert_nothing_unmodelled();
    Ok(())
}

fn print_note(what: &str) {
    println!("               {what}");
}

/// Seals an image, sends it and starts it. At the end it runs and is confirmed.
fn install(bench: &mut Bench, image: &str, sealer: &Sealer<'_>) -> Outcome<()> {
    let bytes = firmware::raw(image);
    let file = sealer.seal(&bytes, &release())?;
    let counter = sealer.counter;
    print_note(&format!("{image}: {} bytes, {} when sealed, counter {counter}", bytes.len(), file.len()));
    let (_, word) = write(bench, &file, Transfers::Blocks);
    if word != 0 {
        return Err(format!("the device refused it: 1F57h = {word:02X}h").into());
    }
    print_line(bench.time(), "all bytes are in the device, and what they are is what was signed");
    bench.session().command(1, ProgramControl::Start)?;
    let up = bench.await_boot_up(1000);
    print_line(up, "boot-up: the program was started");
    bench.session().command(1, ProgramControl::Stop)?;
    bench.run_ms(100);
    print_line(bench.time(), "it was stopped: it has brought the device back, which confirms it");
    bench.session().command(1, ProgramControl::Start)?;
    let up = bench.await_boot_up(1000);
    print_line(up, "boot-up: it runs again");
    introduce(bench)
}

/// Sends an image that the device must refuse; then the power fails, and the old program starts.
fn refuse(bench: &mut Bench, file: &[u8]) -> Outcome<()> {
    bench.session().command(1, ProgramControl::StartBootloader)?;
    bench.await_boot_up(1000);
    bench.run_ms(50);
    let (abort, word) = write(bench, file, Transfers::Blocks);
    let Some(error) = FlashStatus::from_word(word).error else {
        return Err("the device took it".into());
    };
    if let Some(code) = abort {
        print_line(bench.time(), &format!("the device breaks the transfer off: {}", AbortCode(code)));
    }
    print_line(bench.time(), &format!("refused, 1F57h = {word:02X}h: {error}"));
    bench.power_cycle();
    bench.await_boot_up(1000);
    if bench.is_bootloader(NODE) {
        return Err("the old program does not start".into());
    }
    print_line(bench.time(), "the power fails and comes back: the old program starts");
    introduce(bench)
}

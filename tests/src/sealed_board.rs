//! Sealed devices and sealed images. The keys are made from fixed seeds, so that every run is the
//! same.

use std::sync::LazyLock;

use canopen::program::ProgramControl;
use canopen::Address;
use coflash_core::device::{Doing, Transfers};
use coflash_core::file::sealed::{key_block, Certificate, Kek, Role, Sealer, SigningKey};
use kit::rig::crc32;

use crate::bench::{abort_code, Bench, NODE};
use crate::firmware;

/// 1F50h/1 and 1F57h/1.
const DATA: Address = Address::new(0x1F50, 1);
const STATUS: Address = Address::new(0x1F57, 1);
const VERSION: Address = Address::new(0x100A, 0);
const CRC_OF_PROGRAM: Address = Address::new(0x1F56, 1);

/// The words of 1F57h: the error code from bit 1 on (SYS TEC manual, table 3; from 8Ah on the codes
/// of sealed images).
pub mod status {
    /// No error.
    pub const OK: u32 = 0;
    /// FORMAT.
    pub const FORMAT: u32 = 0x04;
    /// CRC.
    pub const CRC: u32 = 0x06;
    /// WRONG_PRODUCT_ID.
    pub const WRONG_PRODUCT: u32 = 0x82;
    /// NO_ACCESS.
    pub const NO_ACCESS: u32 = 0x84;
    /// SEQUENCE.
    pub const SEQUENCE: u32 = 0x88;
    /// SIGNATURE.
    pub const SIGNATURE: u32 = 0x8A;
    /// ROLLBACK.
    pub const ROLLBACK: u32 = 0x8C;
    /// KEY.
    pub const KEY: u32 = 0x8E;
}

/// The lowest security counter that a new device accepts, and the counter of [`sealer`].
pub const COUNTER: u32 = 7;

/// The key-encryption key of the devices.
pub static KEKS: LazyLock<[Kek; 1]> = LazyLock::new(|| [Kek::new(KEK).expect("its id is not 0")]);

/// The bytes of [`KEKS`]: all are different, and no four consecutive ones occur in any code.
pub const KEK: [u8; 32] = {
    let mut bytes = [0; 32];
    let mut at = 0;
    while at < 32 {
        bytes[at] = 0x9D ^ (at as u8).wrapping_mul(73);
        at += 1;
    }
    bytes
};

/// A signing key from a seed.
pub fn key(seed: u8) -> SigningKey {
    SigningKey::from_seed([seed; 32]).expect("its id is not 0")
}

/// The root of the devices.
pub fn root() -> SigningKey {
    key(1)
}

/// The key that signs programs, certified by [`root`].
pub fn release() -> SigningKey {
    key(2)
}

/// A program for the board's product with this security counter, neither compressed nor encrypted,
/// to be signed by [`release`].
pub fn sealer(counter: u32) -> Sealer<'static> {
    sealer_of_epoch(counter, 1)
}

/// The same, with a certificate of this epoch.
pub fn sealer_of_epoch(counter: u32, epoch: u32) -> Sealer<'static> {
    let bsp::Identity { vendor_id, product_code, .. } = bsp::IDENTITY;
    let certificate = Certificate {
        role: Role::Release,
        epoch,
        vendor_id,
        product_code: 0,
        lowest: 0,
        highest: u32::MAX,
        key: release().public(),
    };
    let certificate = Some(certificate.signed_by(&root()));
    Sealer { certificate, vendor_id, product_code, counter, ..Sealer::default() }
}

/// A board with the bootloader for sealed images and its keys, still without power.
///
/// # Panics
/// If the firmware was not built.
pub fn board() -> Bench {
    board_of(firmware::BOOTLOADER_SEALED)
}

/// The same with another bootloader that takes sealed images.
///
/// # Panics
/// If the firmware was not built.
pub fn board_of(bootloader: &str) -> Bench {
    let mut bench = Bench::of_image(bootloader);
    provision(&mut bench);
    bench
}

/// Writes the keys into a board, as in production: it is a sealed device after its next reset.
pub fn provision(bench: &mut Bench) {
    let place = firmware::board().key_block();
    bench.machine().load_bin(place.base, &keys()).expect("it is in flash");
}

/// An application as a sealed image, signed by [`release`].
pub fn seal(sealer: &Sealer<'_>, image: &str) -> Vec<u8> {
    sealer.seal(&firmware::raw(image), &release()).expect("it can be sealed")
}

/// Starts the downloaded program, and checks that it is the right one.
pub fn start(bench: &mut Bench, image: &str, version: &str) {
    let crc = bench.session().read_number(CRC_OF_PROGRAM).unwrap();
    assert_eq!(crc, crc32(&firmware::raw(image)));
    bench.session().command(1, ProgramControl::Start).unwrap();
    bench.await_boot_up(1000);
    assert!(!bench.is_bootloader(NODE), "{image} was not started");
    assert_eq!(bench.session().read_text(VERSION).unwrap(), version);
    assert_eq!(bench.session().read_number(CRC_OF_PROGRAM).unwrap(), crc);
}

/// Stops the program: the device returns to the bootloader, which confirms the program. (The first
/// 80h after a download in one transfer would mean "confirm".)
pub fn call_back(bench: &mut Bench) {
    bench.session().command(1, ProgramControl::Stop).unwrap();
    bench.run_ms(100);
    assert!(bench.is_bootloader(NODE));
}

/// A sealed device in its bootloader, with version 1 installed, started once and confirmed.
pub fn board_with_a_program() -> Bench {
    let mut bench = board().switched_on();
    let file = seal(&sealer(COUNTER), firmware::APP_V1);
    assert_eq!(write(&mut bench, &file, Transfers::Blocks), (None, status::OK));
    start(&mut bench, firmware::APP_V1, "1.0.0");
    call_back(&mut bench);
    bench
}

/// The key block of the devices.
pub fn keys() -> [u8; 256] {
    key_block(&[root().public()], &*KEKS, COUNTER, 0, false).expect("one root and one key")
}

/// The same without keys: a device that is not sealed.
pub fn open_board() -> Bench {
    Bench::of_image(firmware::BOOTLOADER_SEALED)
}

/// Sends CLEAR and writes a file to 1F50h as a whole, like any master; returns the abort code, if
/// any, and the word of 1F57h after the device is no longer busy.
///
/// # Panics
/// If the device does not answer.
pub fn write(bench: &mut Bench, file: &[u8], transfers: Transfers) -> (Option<u32>, u32) {
    write_to(bench, 1, file, transfers)
}

/// The same for another program.
///
/// # Panics
/// As [`write`](fn@write).
pub fn write_to(bench: &mut Bench, program: u8, file: &[u8], transfers: Transfers) -> (Option<u32>, u32) {
    let mut session = bench.session();
    session.transfer_by(transfers);
    session.command(program, ProgramControl::Clear).expect("CLEAR is answered");
    session.await_idle(program, Doing::Command(ProgramControl::Clear)).expect("1F57h is answered");
    let data = Address { sub: program, ..DATA };
    let abort = abort_code(session.write(data, file, Doing::Program, &mut |_| {}));
    let status = session.await_idle(program, Doing::Read(STATUS)).expect("1F57h is answered");
    (abort, status.to_word())
}

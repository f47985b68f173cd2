//! The renewal of the bootloader of an emulated board: the steps of a tool, one by one.

use canopen::program::{
    FlashStatus, ProgramControl, DEVICE_STATE, PROGRAM_DATA, PROGRAM_ID, STATE_RENEWAL, STATE_VERSIONS,
};
use canopen::Address;
use coflash_core::device::Doing;
use coflash_core::file::ram_image::RamImage;
use coflash_core::file::read::{read, Firmware, Format};
use coflash_core::update::Payload;
use emulator::time::Span;
use kit::crc::crc32;
use shared_abi::geometry::Region;
use shared_abi::renewal::{Progress, State};

use crate::bench::Bench;
use crate::firmware;

/// The program number of the bootloader of the tested board: it follows those of the layout.
pub fn number() -> u8 {
    shared_abi::renewal::number(firmware::board().programs.len() as u8, None)
}

/// The RAM image of a built bootloader, with its header.
pub fn image_of(bootloader: &str) -> Vec<u8> {
    let elf = firmware::elf(bootloader);
    let (_, header) = firmware::section(&elf, ".ram_image");
    let (_, ram) = firmware::section(&elf, ".data");
    [header, ram].concat()
}

/// The image with the right CRC in its header.
pub fn with_crc(mut image: Vec<u8>) -> Vec<u8> {
    let crc = crc32(&image[8..]);
    image[4..8].copy_from_slice(&crc.to_le_bytes());
    image
}

/// A built image with another word in its header.
pub fn with_word(bootloader: &str, at: usize, word: u32) -> Vec<u8> {
    let mut image = image_of(bootloader);
    image[at..at + 4].copy_from_slice(&word.to_le_bytes());
    with_crc(image)
}

/// A built image with another version.
pub fn version(bootloader: &str, version: u32) -> Vec<u8> {
    with_word(bootloader, 48, version)
}

/// What the tool makes of an image in a file.
///
/// # Panics
/// If the image has no header.
pub fn plain(image: &[u8]) -> Payload {
    let Ok(Firmware::Image(image)) = read(image, Some(Format::Raw), Some(0)) else { panic!("a raw file") };
    RamImage::find(&image).expect("a RAM image").into()
}

/// The CRC in the header of an image.
///
/// # Panics
/// If the image has no header.
pub fn crc_of(image: &[u8]) -> u32 {
    u32::from_le_bytes(image[4..8].try_into().expect("four bytes"))
}

/// 2007h/9.
///
/// # Panics
/// If the device does not answer.
pub fn progress(bench: &mut Bench) -> Progress {
    let word = bench.number(DEVICE_STATE, STATE_RENEWAL);
    Progress::from_bytes(word.to_le_bytes()).expect("an answer")
}

/// 1F57h of the bootloader, when it is no longer busy.
///
/// # Panics
/// If the device does not answer.
pub fn status(bench: &mut Bench) -> FlashStatus {
    bench
        .session()
        .await_idle(number(), Doing::Write(Address::new(PROGRAM_DATA, number())))
        .expect("an answer")
}

/// Downloads an image into staging.
///
/// # Panics
/// If the device refuses it.
pub fn stage(bench: &mut Bench, image: &[u8]) {
    let at = Address::new(PROGRAM_DATA, number());
    bench.session().command(number(), ProgramControl::Clear).expect("an answer");
    bench.session().write(at, image, Doing::Write(at), &mut |_| {}).expect("an answer");
    assert_eq!(status(bench), FlashStatus::OK);
    assert_eq!(progress(bench).state, State::Staged);
}

/// START of the staged image; the time from the answer to the next boot-up.
///
/// # Panics
/// If there is none within five seconds.
pub fn start(bench: &mut Bench) -> Span {
    bench.session().command(number(), ProgramControl::Start).expect("an answer");
    let answered = bench.time();
    bench.await_boot_up(5_000) - answered
}

/// 83h on trial; returns when the image is installed.
///
/// # Panics
/// If it is not.
pub fn confirm(bench: &mut Bench) {
    bench.session().command(number(), ProgramControl::SetSignature).expect("an answer");
    assert_eq!(status(bench), FlashStatus::OK);
    assert_eq!(progress(bench).state, State::Installed);
}

/// The version of the running image.
///
/// # Panics
/// If the device does not answer.
pub fn running(bench: &mut Bench) -> u32 {
    let at = Address::new(DEVICE_STATE, STATE_VERSIONS);
    let value = bench.session().read(at).expect("an answer");
    u32::from_le_bytes(value[..4].try_into().expect("an answer"))
}

/// 1F56h of the bootloader.
///
/// # Panics
/// If the device does not answer.
pub fn identification(bench: &mut Bench) -> u32 {
    bench.session().read_number(Address::new(PROGRAM_ID, number())).expect("an answer")
}

/// The flash of a place.
///
/// # Panics
/// If it is outside the chip.
pub fn cells(bench: &Bench, place: Region) -> Vec<u8> {
    bench.memory(place.base, place.size as usize)
}

//! Devices whose bootloader can be renewed: their layouts, RAM images for them, and the part of the resident part
//! that loads one (docs/renewal.md).

use boot_core::canopen::BitRate;
use boot_core::control::Renewal;
use boot_core::crc32;
use boot_core::decision::{choose, Exit, Images, Policy, Woken};
use boot_core::flash::Flash;
use boot_core::renewal::{check_contents, header, Places};
use boot_core::store::Journal;
use shared_abi::abilities::Abilities;
use shared_abi::geometry::{Geometry, Region, SectorRun};
use shared_abi::layout::Layout;
use shared_abi::ram_image::{Header, Host, MAGIC, SERVICES_VERSION};
use shared_abi::renewal::{of_word, Origin, TrialEnd};
use shared_abi::warm_start::{BootRequest, Damage};

use crate::model::{CHIP, ONE_PROGRAM};

pub const HOME: Region = Region::new(0x0800_0800, 0x400);
pub const STAGING: Region = Region::new(0x0800_3C00, 0x800);
pub const PROGRAM: Region = Region::new(0x0800_0C00, 0x3800);
pub static LAYOUT: Layout = Layout {
    bootloader: Region::new(0x0800_0000, 0x200),
    parameters: [Region::new(0x0800_0200, 0x200), Region::new(0x0800_0400, 0x200)],
    home: Some(HOME),
    programs: &[PROGRAM],
    staging: Some(STAGING),
    ..ONE_PROGRAM
}
.checked();
/// With two programs: staging is the end of the second one.
pub static TWO: Layout =
    Layout { programs: &[Region::new(0x0800_0C00, 0x1800), Region::new(0x0800_2400, 0x2000)], ..LAYOUT }
        .checked();
static LARGER: Geometry = Geometry {
    flash: Region::new(0x0800_0000, 0xC400),
    sectors: &[CHIP.sectors[0], CHIP.sectors[1], CHIP.sectors[2], SectorRun { count: 2, size: 0x4000 }],
    ..CHIP
};
/// [`TWO`] with a journal in two sectors more, which are as large as on a chip.
pub static LARGE_JOURNAL: Layout = Layout {
    chip: &LARGER,
    parameters: [Region::new(0x0800_4400, 0x4000), Region::new(0x0800_8400, 0x4000)],
    ..TWO
}
.checked();
pub const PLACES: Places = match Places::of(&LAYOUT) {
    Some(places) => places,
    None => panic!("the layout has staging"),
};

pub const BOARD: u32 = 0x1234_5678;
/// What the resident part has.
pub const HOST: Host =
    Host { board: BOARD, services: SERVICES_VERSION, features: Abilities::RENEWAL, facts: 0 };
pub const RENEWAL: Renewal = Renewal {
    board: BOARD,
    features: Abilities::RENEWAL,
    identity: Some((7, 8)),
    revision: 3,
    ..Renewal::NONE
};
pub const SOUND: Header = Header {
    magic: MAGIC,
    crc: 0,
    length: Header::SIZE,
    size: 0,
    ram_base: LAYOUT.ram.base,
    ram_end: LAYOUT.bootloader_ram().end(),
    services: SERVICES_VERSION,
    features: Abilities::RENEWAL,
    board: BOARD,
    vendor: 7,
    product: 8,
    revisions: 0,
    version: 0x0001_0002,
    counter: 0,
    facts: 0,
    reserved: 0,
};

pub fn words(header: &Header) -> Vec<u8> {
    let Header { magic, crc, length, size, ram_base, ram_end, services, features, .. } = *header;
    let Header { board, vendor, product, revisions, version, counter, facts, reserved, .. } = *header;
    [
        magic, crc, length, size, ram_base, ram_end, services, features.0, board, vendor, product, revisions,
        version, counter, facts, reserved,
    ]
    .into_iter()
    .flat_map(u32::to_le_bytes)
    .collect()
}

/// An image with this header; the CRC is written unless the header has the CRC `bench`.
pub fn image_of(header: Header, size: usize, fill: u8, has_crc: bool) -> Vec<u8> {
    let mut image = words(&Header { size: size as u32, ..header });
    image.extend([header.ram_end, header.ram_base + 0x41].into_iter().flat_map(u32::to_le_bytes));
    image.extend((8..size).map(|at| fill ^ at as u8));
    if has_crc {
        let crc = crc32(&image[8..]).to_le_bytes();
        image[4..8].copy_from_slice(&crc);
    }
    image
}

pub fn image(size: usize, fill: u8) -> Vec<u8> {
    image_of(SOUND, size, fill, true)
}

pub fn crc_of(image: &[u8]) -> u32 {
    u32::from_le_bytes(image[4..8].try_into().unwrap())
}

/// The checks of the resident part before it loads an image.
pub fn load(flash: &impl Flash, place: Region, host: Host) -> Result<Header, Damage> {
    let header = header(flash, place);
    check_contents(flash, place, &header, &LAYOUT, host).map(|()| header)
}

/// The image that the boot stage loads after a reset with this request, if it stays in the
/// bootloader; `None` if it can load none.
pub fn loads(
    flash: &impl Flash,
    layout: &Layout,
    host: Host,
    request: Option<BootRequest>,
) -> Option<(Header, Origin, TrialEnd)> {
    let journal = Journal::open(flash, layout.parameters);
    let woken = Woken { request, strap: true, ..Woken::power_on(1, BitRate::K125) };
    let images =
        Images { home: PLACES.home, staging: PLACES.staging, check: |place| load(flash, place, host) };
    let policy = Policy { renewal: true, ..Policy::plain(&LAYOUT, &[1]) };
    match choose(&woken, &images, flash, &journal, &policy).exit {
        Exit::Bootloader { origin, image, renewal, .. } => Some((image, origin, of_word(renewal).1)),
        _ => None,
    }
}

//! What can be sent to a device: RAM images that may run on it and others, and programs.

use std::cell::RefCell;
use std::collections::HashMap;
use std::rc::Rc;

use coflash_core::file::sealed::{Certificate, Sealer};
use kit::random::Random;
use kit::renewal::{crc_of, image_of, BOARD, HOME, SOUND, STAGING};
use kit::rig::{block, crc32, hex, program, words, Setup, PRODUCT_CODE, VENDOR_ID};
use shared_abi::ram_image::Header;
use shared_abi::renewal::BOOTLOADER;

use crate::sealed::{certificate, keys, sealer, Parts};

/// What a download contains.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Content {
    /// The RAM image of a bootloader: 0 to 3 and 6 may run here, 4 is damaged, and 5 is for another
    /// board.
    Image(u8),
    /// A program with this number, for its place.
    Program(u8, Extent),
    /// The same in the size, with the security counter and in the form of this row of [`RELEASES`].
    Release(u8, u8),
    /// Bytes of this seed. Some begin as valid data do.
    Noise(u64),
    /// Bytes that a fuzzer has chosen: see [`free`].
    Free(usize),
}

/// Bytes, security counter, and whether it is encrypted and compressed.
pub const RELEASES: [(usize, u32, (bool, bool)); 6] = [
    (8, 3, (false, false)),
    (300, 3, (true, false)),
    (560, 5, (false, false)),
    (1500, 5, (false, true)),
    (900, 7, (true, true)),
    (700, 9, (true, false)),
];
/// The security counter of other programs: at least that of each release.
const COUNTER: u32 = 9;

impl Content {
    /// The security counter of a sealed program.
    #[must_use]
    pub fn counter(self) -> u32 {
        match self {
            Self::Release(_, row) => RELEASES[usize::from(row)].1,
            Self::Program(..) => COUNTER,
            Self::Image(_) | Self::Noise(_) | Self::Free(_) => 0,
        }
    }

    /// Whether it is something with this program number.
    fn is_of(self, sub: u8) -> bool {
        matches!(self, Self::Program(number, _) | Self::Release(number, _) if number == sub)
    }

    /// Whether it is a file that its owner has made.
    fn is_made(self) -> bool {
        !matches!(self, Self::Noise(_) | Self::Free(_))
    }
}

/// Changes of bytes: at this place, modulo the length, to this value.
pub type Changes = [(u16, u8); 3];

/// What of it is one transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// This block of a block file, counted from 0, modulo their number.
    Block(usize),
    /// All of it, raw or sealed.
    Whole,
    /// All of it as Intel HEX. (A sealed device has no other form than sealed.)
    Hex,
}

/// What is wrong with a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Flaw {
    None,
    /// A flipped bit in this byte, modulo the length.
    Bit(usize),
    /// A wrong CRC of a block, or checksum of a record.
    Crc,
    /// This address, of the data or of the program's start.
    Address(u32),
    /// The identity of another product.
    Product,
    /// Its end is missing: so many thousandths.
    Short(usize),
    /// So many bytes after it.
    Long(usize),
    /// Another number of a block.
    Number(u32),
    /// In the last block, another CRC of the program.
    Sum,
    /// A device with keys gets it as if it had none.
    Unsealed,
    /// This chunk of a sealed image, modulo their number, is missing, or comes twice.
    Chunk(usize, bool),
    /// The chunks of this release.
    Head(u8),
    /// Signed by a stranger, with a certificate of his own.
    Stranger,
    /// Signed by the owner, with these changes in the manifest, or in the payload. It may be
    /// accepted.
    Signed(Changes, bool),
}

/// A transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sent {
    pub content: Content,
    pub part: Part,
    pub flaw: Flaw,
}

/// The size of a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Extent {
    /// It leaves staging alone.
    Small,
    /// It reaches into staging, or nearly fills its flash.
    Large,
    /// The same, and its control block does not tell it.
    Untold,
    /// So many bytes, and no fewer than 8.
    Bytes(usize),
}

/// The bootloader of a new device.
pub const OLD: Content = Content::Image(0);
/// The one that a tool installs at last.
pub const NEWEST: Content = Content::Image(3);
/// The program after an update.
pub const NEW: Content = Content::Program(1, Extent::Bytes(0xE0));

pub struct File {
    /// The bytes in flash.
    pub plain: Vec<u8>,
    /// The blocks of a block file, or the only part of a sealed image: each is a transfer.
    pub blocks: Vec<Vec<u8>>,
    /// Raw or sealed, for one transfer.
    pub whole: Vec<u8>,
    /// Where the first byte is.
    base: u32,
    /// The CRC by which a device knows it.
    pub crc: u32,
}

/// The file with this content for a device.
pub fn file(setup: &'static Setup, content: Content) -> Rc<File> {
    type Key = (&'static str, bool, Content);
    thread_local! {
        static FILES: RefCell<HashMap<Key, Rc<File>>> = RefCell::default();
    }
    let make = || Rc::new(make(setup, content));
    if matches!(content, Content::Free(_)) {
        return make();
    }
    let key = (setup.name, setup.takes_sealed, content);
    FILES.with(|files| files.borrow_mut().entry(key).or_insert_with(make).clone())
}

thread_local! {
    static FREE: RefCell<Vec<Vec<u8>>> = RefCell::default();
}

/// Content of these bytes, until [`forget`].
#[must_use]
pub fn free(bytes: &[u8]) -> Content {
    FREE.with_borrow_mut(|all| {
        all.push(bytes.to_vec());
        Content::Free(all.len() - 1)
    })
}

/// Forgets the bytes of [`free`].
pub fn forget() {
    FREE.with_borrow_mut(Vec::clear);
}

impl Sent {
    /// The bytes of the transfer.
    #[must_use]
    pub fn bytes(self, setup: &'static Setup) -> Vec<u8> {
        let file = file(setup, self.content);
        let is_plain = !setup.takes_sealed || self.flaw == Flaw::Unsealed;
        let (mut bytes, is_block) = match (self.part, self.flaw) {
            (Part::Block(block), _) => {
                (file.blocks[block % file.blocks.len()].clone(), file.blocks.len() > 1)
            }
            (Part::Hex, Flaw::Address(base)) if is_plain => return hex(base, &file.plain),
            (Part::Hex, _) if is_plain => (hex(file.base, &file.plain), false),
            (Part::Whole, Flaw::Unsealed) => (file.plain.clone(), false),
            _ if setup.takes_sealed && self.content.is_made() => (self.sealed(setup, &file), false),
            _ => (file.whole.clone(), false),
        };
        let len = bytes.len();
        let is_last = is_block && matches!(self.part, Part::Block(n) if (n + 1) % file.blocks.len() == 0);
        let product = || bytes.windows(4).position(|word| word == PRODUCT_CODE.to_le_bytes());
        let other_word = match self.flaw {
            // The header of a block has its address, and a program begins with its vector table.
            Flaw::Address(address) => Some((4, address)),
            // Of the control block, or of the label.
            Flaw::Product => product().map(|at| (at, !PRODUCT_CODE)),
            Flaw::Number(number) if is_block => Some((0, number)),
            Flaw::Sum if is_last => Some((16, !file.crc)),
            _ => None,
        };
        if let Some((at, word)) = other_word {
            bytes[at..at + 4].copy_from_slice(&word.to_le_bytes());
            if is_block {
                let crc = crc32(&bytes[..len - 4]).to_le_bytes();
                bytes[len - 4..].copy_from_slice(&crc);
            }
        }
        match self.flaw {
            Flaw::Bit(n) => bytes[n % len] ^= 1 << (n / len % 8),
            Flaw::Crc => bytes[len - 1] ^= 1,
            Flaw::Short(thousandths) => bytes.truncate(len * (1000 - thousandths) / 1000),
            Flaw::Long(more) => bytes.resize(len + more, 0x5A),
            _ => {}
        }
        bytes
    }

    /// A sealed image with a flaw of its own.
    fn sealed(self, setup: &'static Setup, file: &File) -> Vec<u8> {
        let parts = || Parts::of(&file.whole);
        match self.flaw {
            Flaw::Chunk(n, is_twice) => {
                let Parts { manifest, chunks, .. } = parts();
                let mut all: Vec<&[u8]> = chunks.chunks(32 + (1 << manifest[25])).collect();
                let n = n % all.len();
                if is_twice {
                    all.insert(n, all[n]);
                } else {
                    all.remove(n);
                }
                Parts { chunks: all.concat(), ..parts() }.bytes()
            }
            Flaw::Head(row) => {
                let program = if let Content::Release(program, _) = self.content { program } else { 1 };
                let other = crate::files::file(setup, Content::Release(program, row));
                Parts { chunks: Parts::of(&other.whole).chunks, ..parts() }.bytes()
            }
            Flaw::Stranger => {
                let stranger = &keys().stranger;
                let mut own = Certificate { key: stranger.public(), ..certificate() }.signed_by(stranger);
                own[60..64].copy_from_slice(&keys().root.public().id().to_le_bytes());
                parts().with(20, &500_u32.to_le_bytes()).certified(&own).signed_by(stranger).bytes()
            }
            Flaw::Signed(changes, in_payload) => {
                let change = |bytes: &mut [u8]| {
                    let len = bytes.len();
                    changes.iter().for_each(|(at, value)| bytes[usize::from(*at) % len] = *value);
                };
                let mut parts = parts();
                if in_payload {
                    let mut payload = parts.payload();
                    change(&mut payload);
                    parts = parts.with_payload(&payload);
                } else {
                    change(&mut parts.manifest);
                }
                parts.signed()
            }
            _ => file.whole.clone(),
        }
    }

    /// The CRC of the program that the transfer makes or completes, if it is accepted.
    pub(crate) fn crc(self, setup: &'static Setup, sub: u8) -> u32 {
        // Any beginning of a program is one, too, and data may be any bytes.
        let is_raw = (self.part == Part::Whole || setup.is_data(sub)) && !setup.takes_sealed;
        if is_raw {
            crc32(&self.bytes(setup))
        } else {
            file(setup, self.content).crc
        }
    }

    /// Whether it completes a program, if it is accepted.
    pub(crate) fn completes(self, setup: &'static Setup, sub: u8) -> bool {
        let blocks = file(setup, self.content).blocks.len();
        let is_last = |n: usize| (n + 1).is_multiple_of(blocks) && self.flaw != Flaw::Sum;
        !matches!(self.part, Part::Block(n) if !is_last(n)) || setup.is_data(sub)
    }

    /// Whether it is no block of several: its first bytes may be accepted, and the rest not.
    pub(crate) fn is_stream(self, setup: &Setup, sub: u8) -> bool {
        !matches!(self.part, Part::Block(_)) || setup.is_data(sub)
    }

    /// Whether it has data that this program may have.
    pub(crate) fn fits(self, setup: &'static Setup, sub: u8) -> bool {
        // A block has its data whatever its number is.
        let is_numbered = matches!(self.flaw, Flaw::Number(_));
        let is_sound = || is_numbered || self.bytes(setup) == Self { flaw: Flaw::None, ..self }.bytes(setup);
        // Another address is in the first bytes; any other flaw may come after accepted ones.
        let is_first = matches!(self.flaw, Flaw::Address(_) | Flaw::Stranger) || self.is_unsealed(setup);
        let is_late = self.is_stream(setup, sub) && !is_first;
        setup.is_data(sub) && !setup.takes_sealed || self.content.is_of(sub) && (is_late || is_sound())
    }

    /// Whether a device with keys gets it as if it had none.
    fn is_unsealed(self, setup: &Setup) -> bool {
        setup.takes_sealed && self.flaw == Flaw::Unsealed
    }
}

/// Whether an image with this CRC may run on a device.
pub fn may_run(setup: &'static Setup, crc: u32) -> bool {
    counter_of_image(setup, crc).is_some()
}

/// The security counter of the image with this CRC, if it may run on a device.
pub fn counter_of_image(setup: &'static Setup, crc: u32) -> Option<u32> {
    let is_it = |which: &u8| file(setup, Content::Image(*which)).crc == crc;
    [0, 1, 2, 3, 6].into_iter().find(is_it).map(image_counter)
}

/// The security counter of an image: 6 has that of 1.
fn image_counter(which: u8) -> u32 {
    if which == 6 {
        image_counter(1)
    } else {
        1 + u32::from(which)
    }
}

fn make(setup: &Setup, content: Content) -> File {
    let (number, base, chunk, plain) = match content {
        Content::Image(which) => {
            let counter = image_counter(which);
            let board = if which == 5 { !BOARD } else { BOARD };
            let features = setup.host().features;
            let of = Header { counter, board, features, vendor: 0, product: 0, version: counter, ..SOUND };
            let mut image = image_of(of, 0x200 + 0x40 * usize::from(which % 4), which, true);
            image[0x100] ^= u8::from(which == 4);
            (BOOTLOADER, HOME.base, 200, image)
        }
        Content::Program(number, extent) => {
            let region = setup.region(number);
            let end = if region.end() > STAGING.base { STAGING.base + 0x180 } else { region.end() - 0x80 };
            let (size, fill) = match extent {
                Extent::Small => (0x500, 0),
                Extent::Bytes(size) => (size, size as u8),
                Extent::Large => ((end - region.base) as usize, 0x10),
                Extent::Untold => ((end - region.base) as usize, 0x20),
            };
            // Nearly all of the flash in few blocks.
            let chunk = if size > 0x800 { 1000 } else { 200 };
            (number, region.base, chunk, program(region, PRODUCT_CODE, size, number | fill))
        }
        Content::Release(number, row) => {
            let region = setup.region(number);
            let size = RELEASES[usize::from(row)].0;
            (number, region.base, 96, program(region, PRODUCT_CODE, size, (16 * number) | row))
        }
        Content::Free(which) => {
            let bytes = FREE.with_borrow(|all| all[which].clone());
            let (base, crc, size) = (setup.region(1).base, crc32(&bytes), bytes.len() as u32);
            let blocks = vec![
                block(0, 0, &words(&[size, VENDOR_ID, PRODUCT_CODE])),
                block(1, base, &bytes),
                block(u32::MAX, 0, &words(&[size, crc])),
            ];
            return File { plain: bytes.clone(), blocks, whole: bytes, base, crc };
        }
        Content::Noise(seed) => {
            let mut random = Random(seed);
            let starts: [&[u8]; 6] =
                [b":020", b"CBS1", &[0; 4], &[1, 0, 0, 0], &[0xC0, 0xFF, 0x01, 0x20], &[0xFF; 4]];
            let mut bytes = random.pick(&starts).to_vec();
            bytes.extend((0..8 + random.below(300)).map(|_| random.below(256) as u8));
            // Of no form: it has neither heads nor a seal.
            let crc = crc32(&bytes);
            return File { plain: bytes.clone(), blocks: vec![bytes.clone()], whole: bytes, base: 0, crc };
        }
    };
    let crc = if number == BOOTLOADER { crc_of(&plain) } else { crc32(&plain) };
    let whole = if setup.takes_sealed { sealed(setup, number, content, &plain) } else { plain.clone() };
    let (size, sum) = (whole.len() as u32, crc32(&whole));
    let is_told = !matches!(content, Content::Image(_) | Content::Program(_, Extent::Untold));
    let reported = if is_told { size } else { 0 };
    let mut blocks = vec![block(0, 0, &words(&[reported, VENDOR_ID, PRODUCT_CODE]))];
    for (n, data) in (0..).zip(whole.chunks(chunk)) {
        blocks.push(block(1 + n, base + n * chunk as u32, data));
    }
    blocks.push(block(u32::MAX, 0, &words(&[size, sum])));
    File { whole, plain, blocks, base, crc }
}

/// Signed by the release key, or by the root itself.
fn sealed(setup: &Setup, program: u8, content: Content, plain: &[u8]) -> Vec<u8> {
    let data = setup.is_data(program);
    let made = match content {
        Content::Release(_, row) => {
            let (_, counter, form) = RELEASES[usize::from(row)];
            let sealer = Sealer {
                program,
                counter,
                version: u32::from(row) + 1,
                chunk: 9 + row % 3,
                data,
                ..sealer(form)
            };
            sealer.seal(plain, &keys().release)
        }
        _ => {
            let counter = if let Content::Image(which) = content { image_counter(which) } else { COUNTER };
            Sealer { program, counter, data, certificate: None, ..sealer((false, false)) }
                .seal(plain, &keys().root)
        }
    };
    made.expect("it can be sealed")
}

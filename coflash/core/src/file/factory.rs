//! A file for production: a bootloader, and a first program with the records that the device would have stored
//! itself. A device from the line starts this program at its first power-on, without CAN.

use seal::key_block::{
    COUNTER, EPOCH, FLAGS, FOR_TESTS, KEKS, KEK_COUNT, KEY, MAGIC, ROOTS, ROOT_COUNT, SIZE,
};
use seal::wire::{array, flag, word};
use shared_abi::abilities::Abilities;
use shared_abi::block_file::fits;
use shared_abi::geometry::{Region, OTP};
use shared_abi::journal::{self, slot, Key, ProgramRecord, Seal, Value, HEADER_MAGIC, SLOT_SIZE};
use shared_abi::layout::{toml::Toml, Layout, KNOWS_SEALED_IMAGES, MARK_OFFSET};
use shared_abi::nameplate::{Nameplate, BLOCKS};
use shared_abi::ram_image::Header;
use shared_abi::services::{Facts, OFFSET};

use super::checksum::{Checksum, CRC};
use super::fault::Place;
use super::image::{Image, Pieces};
use super::judge::{self, judge};
use super::program::{Program, Target};
use super::ram_image::{self, RamImage};
use super::range::AddressRange;
use super::sealed::open::Closed;
use super::sealed::provision::{check_place, ProvisionFault};
use super::sealed::{verify, Device, Kek, PublicKey, Refusal, SealedFile};

/// Why there is no file for production.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Fault {
    /// The bootloader is none, or is elsewhere.
    #[error(transparent)]
    Bootloader(#[from] ProvisionFault),
    /// Its resident part says nothing of itself.
    #[error(
        "it is not a coboot bootloader with the services of this version: give bootloader.elf of a release"
    )]
    NoFacts,
    /// It is linked for another memory map.
    #[error("it was built for another memory map than that of {0}: name the board that it was built for, or its file")]
    OtherBoard(&'static str),
    /// Its RAM image is absent, without a CRC, or damaged.
    #[error("it {0}: {advice}", advice = ram_image::Fault::ADVICE)]
    RamImage(ram_image::Fault),
    /// It takes sealed images and has no keys.
    #[error(
        "it takes sealed images and has no keys, so that its devices would take any program: put the keys in by \
         coflash seal provision, and give the file that it writes"
    )]
    NoKeys,
    /// What is at the place of the keys is no key block.
    #[error(
        "its key block is damaged, so that its devices would take no program: provision the bootloader again"
    )]
    Keys,
    /// The file is no nameplate.
    #[error("it is not a nameplate: give the file that coflash seal nameplate writes")]
    NoNameplate,
    /// Its product has its identity from the board file.
    #[error(
        "the bootloader does not read a nameplate: leave it out, or build the product with identity.source \
         IdentitySource::Otp"
    )]
    UnreadNameplate,
    /// The product does not take the node-ID, or not the bit rate.
    #[error("the bootloader takes node-IDs {0} to {1}, and not each bit rate: see node.ids and node.bit_rates of the product")]
    Node(u8, u8),
    /// The board has no such program.
    #[error("the board has no program {0}: it has {1}")]
    NoProgram(u8, usize),
    /// It lies elsewhere, or reaches over the end.
    #[error(
        "it lies at {0}, and the program of this board at {1}: link it for that place, or make it smaller"
    )]
    Elsewhere(AddressRange, AddressRange),
    /// It is not a program for this place.
    #[error("it {0}: {advice}", advice = .0.advice())]
    Program(judge::Fault),
    /// It is for other devices.
    #[error(
        "it is for vendor-ID {:08X}h, product code {:08X}h, and the device has {:08X}h and {:08X}h: give the program of \
         this product",
        .program.vendor_id, .program.product_code, .device.0, .device.1
    )]
    Identity {
        /// What it is for.
        program: Target,
        /// 1018h/1 and 1018h/2.
        device: (u32, u32),
    },
    /// The device starts no program that was not sealed.
    #[error("it is not sealed, and the device starts no such program: seal it by coflash seal image")]
    Unsealed,
    /// The device takes no sealed images.
    #[error("it is sealed, and the bootloader takes no sealed images: give the program itself, or bootloader-sealed")]
    Sealed,
    /// The device would refuse it.
    #[error("{0}: {advice}", advice = .0.advice())]
    Refused(Refusal),
    /// It has a flag with which the device does not start it.
    #[error("it is marked as {0}: seal it without that")]
    Marked(&'static str),
}

/// The keys of a sealed device.
struct Keys {
    roots: Vec<PublicKey>,
    keks: Vec<Kek>,
    block: [u8; SIZE],
}

/// The bootloader of a file for production: of which board it is, and what it takes.
pub struct Bootloader {
    image: Image,
    layout: &'static Layout,
    /// What its resident part decides by.
    pub facts: Facts,
    /// The header of its RAM image.
    pub header: Header,
    keys: Option<Keys>,
    /// Node-ID and bit rate, if the file has them; otherwise the device has those of the board.
    pub node: Option<(u8, u8)>,
    /// The identity of the device, if the file has it.
    pub nameplate: Option<Nameplate>,
}

/// A first program with its records.
pub struct First {
    /// Its number on the board.
    pub number: u8,
    /// Its record: released, because production decides that it is the device's program.
    pub record: ProgramRecord,
    /// What is in its flash.
    pub image: Image,
    /// What the device knows of it beside the record.
    more: Vec<(Key, Value)>,
}

impl Bootloader {
    /// The bootloader in a file of a board, with its keys if it has been provisioned.
    ///
    /// # Errors
    /// [`Fault`].
    pub fn new(image: Image, layout: &'static Layout) -> Result<Self, Fault> {
        check_place(&image, layout)?;
        let resident = image.flat(layout.bootloader.base, layout.bootloader.size);
        let table = layout.callgate() + OFFSET;
        let (base, board) = (layout.bootloader.base, CRC.checksum(Toml(layout).to_string().as_bytes()));
        let (_, facts) = Facts::of_resident(&resident, base, table).ok_or(Fault::NoFacts)?;
        let ram_image = RamImage::in_bootloader(&image, layout);
        let ram_image =
            ram_image.ok_or(ProvisionFault::NoRamImage(layout.home.unwrap_or(layout.bootloader).base))?;
        ram_image.check().map_err(Fault::RamImage)?;
        let header = *ram_image.header();
        if [facts.board, header.board] != [board; 2] {
            return Err(Fault::OtherBoard(layout.board));
        }
        if Facts::record(&resident, base, table).map(|record| CRC.checksum(record)) != Some(header.facts) {
            return Err(ProvisionFault::OtherResident.into());
        }
        let block = layout.home.and_then(|_| image.part(layout.key_block().into()));
        let block = block.filter(|there| there.only_byte() != Some(0xFF));
        let is_marked = image.bytes(base + MARK_OFFSET) == Some(KNOWS_SEALED_IMAGES.to_le_bytes());
        let keys = match (block, is_marked) {
            (None, false) => None,
            (None, true) => return Err(Fault::NoKeys),
            (Some(_), false) => return Err(ProvisionFault::Open.into()),
            (Some(block), true) => {
                Some(block.bytes(layout.key_block().base).and_then(Keys::new).ok_or(Fault::Keys)?)
            }
        };
        Ok(Self { facts, header, keys, node: None, nameplate: None, layout, image })
    }

    /// The same with the nameplate in a file, for the one-time programmable bytes.
    ///
    /// # Errors
    /// [`Fault::NoNameplate`], [`Fault::UnreadNameplate`].
    pub fn with_nameplate(mut self, plate: &Image) -> Result<Self, Fault> {
        const SIZE: u32 = size_of::<Nameplate>() as u32;
        let first = plate.span().first;
        // After the blocks is a byte for each, which locks it.
        let is_inside =
            AddressRange { first: OTP.base, last: OTP.end() + BLOCKS as u32 - 1 }.contains(&plate.span());
        let words = plate
            .bytes::<{ SIZE as usize }>(first)
            .filter(|_| is_inside && (first - OTP.base).is_multiple_of(SIZE));
        let parsed =
            words.and_then(|bytes| Nameplate::parse(&std::array::from_fn(|at| word(&bytes, 4 * at))));
        if !Abilities(self.facts.abilities.into()).has(Abilities::NAMEPLATE) {
            return Err(Fault::UnreadNameplate);
        }
        self.nameplate = Some(parsed.ok_or(Fault::NoNameplate)?);
        self.image = joined(&[&self.image, plate]);
        Ok(self)
    }

    /// The same with a node-ID, and a bit rate by its index in the table of CiA 305, as layer setting services store
    /// them.
    ///
    /// # Errors
    /// [`Fault::Node`].
    pub fn with_node(mut self, id: u8, bit_rate: u8) -> Result<Self, Fault> {
        let [lowest, highest] = self.facts.node_ids.to_le_bytes();
        if !(lowest..=highest).contains(&id)
            || self.facts.bit_rates.checked_shr(bit_rate.into()).unwrap_or(0) & 1 == 0
        {
            return Err(Fault::Node(lowest, highest));
        }
        self.node = Some((id, bit_rate));
        Ok(self)
    }

    /// Whether its devices take only sealed images.
    #[must_use]
    pub fn is_sealed(&self) -> bool {
        self.keys.is_some()
    }

    /// 1018h/1 and 1018h/2 of its devices, if they are known: a product with nameplates has its board's if there
    /// is none.
    #[must_use]
    pub fn identity(&self) -> Option<(u32, u32)> {
        let header = (self.header.vendor, self.header.product);
        let plate = self.nameplate.map(|plate| (plate.vendor_id, plate.product_code));
        plate.or((header != (0, 0)).then_some(header))
    }

    /// The CRC of its programs.
    #[must_use]
    pub const fn checksum(&self) -> Checksum {
        match self.facts.crc_bits {
            16 => Checksum::Crc16,
            _ => Checksum::Crc32,
        }
    }

    /// Whether a program starts by itself after power-on; `None` if a function of the product decides.
    #[must_use]
    pub fn starts_by_itself(&self, number: u8) -> Option<bool> {
        let list = self.facts.autostart.to_le_bytes();
        (!list.contains(&0xFF)).then(|| list.contains(&number))
    }

    /// A program that is not sealed, with the CRC of the [product](Self::checksum).
    ///
    /// # Errors
    /// [`Fault`].
    pub fn plain(&self, number: u8, program: &Program) -> Result<First, Fault> {
        if self.is_sealed() {
            return Err(Fault::Unsealed);
        }
        let region = self.region(number)?.into();
        program.check_region(region).map_err(|_| Fault::Elsewhere(program.span(), region))?;
        for target in program.targets().into_iter().flatten() {
            self.check_identity(target)?;
        }
        let release = program.release();
        let crc = self.checksum().of_flash(program.start(), program.size(), program.image().runs());
        let version = release.map_or(0, |release| release.version.0);
        let record = ProgramRecord { version, ..ProgramRecord::released(program.size(), crc) };
        let date = release.map_or(0, |release| release.date);
        let date = u32::try_from(date).ok().filter(|date| *date != 0);
        let more = date.map(|date| (Key::date(number), [date, record.crc, 0, 0])).into_iter().collect();
        self.first(number, record, program.image().clone(), more)
    }

    /// The program in a sealed image, as the device takes it: by its keys.
    ///
    /// # Errors
    /// [`Fault`].
    pub fn sealed(&self, number: u8, file: &SealedFile) -> Result<First, Fault> {
        let Keys { roots, keks, block } = self.keys.as_ref().ok_or(Fault::Sealed)?;
        let region = self.region(number)?;
        let (head, identity) = (file.head(), self.identity());
        let opened = verify(
            file.bytes(),
            &Device {
                roots,
                keks,
                vendor_id: identity.map(|(vendor_id, _)| vendor_id),
                product_code: identity.map(|(_, product_code)| product_code),
                revision: self.nameplate.map(|plate| plate.revision),
                program: Some(number),
                room: Some(region.size),
                counter: word(block, COUNTER),
                epoch: word(block, EPOCH),
                for_tests: word(block, FLAGS) & FOR_TESTS != 0,
                ..Device::default()
            },
        );
        let opened = opened.map_err(Fault::Refused)?;
        let has = |which: u8| head.flags() & which != 0;
        let bytes = match (opened.image, opened.closed) {
            _ if has(flag::DATA) => return Err(Fault::Marked("data of an application")),
            _ if has(flag::WRITES_FLASH)
                && Abilities(self.facts.abilities.into()).has(Abilities::RENEWAL) =>
            {
                return Err(Fault::Marked("a program that writes flash, and the bootloader can be renewed"));
            }
            (Some(bytes), _) => bytes,
            (None, Some(Closed::Dictionary)) => return Err(Fault::Refused(Refusal::Dictionary)),
            (None, _) => return Err(Fault::Refused(Refusal::Kek)),
        };
        let seal = if has(flag::WRITES_FLASH) { Seal::WritesFlash } else { Seal::Locked };
        let released = ProgramRecord::released(head.size(), head.crc());
        let record = ProgramRecord { version: head.version(), seal: Some(seal), ..released };
        let mut image = Pieces::default();
        image.add(region.base, bytes, Place::File);
        // No older program of this device was good: the counter is not left to its confirmation.
        let counter = (Key::counter(number), [head.counter(), opened.epoch, head.counter(), 0]);
        self.first(number, record, image.in_order(), vec![counter])
    }

    /// A program for its flash and its device.
    fn first(
        &self,
        number: u8,
        record: ProgramRecord,
        image: Image,
        more: Vec<(Key, Value)>,
    ) -> Result<First, Fault> {
        let region = self.region(number)?;
        judge(&image, region.base, Some(self.layout)).map_err(Fault::Program)?;
        if let Some(label) = super::label::label_of(&image, region.base) {
            self.check_identity(Target { vendor_id: label.vendor_id, product_code: label.product_code })?;
        }
        Ok(First { number, record, image, more })
    }

    fn region(&self, number: u8) -> Result<Region, Fault> {
        self.layout.program(number).ok_or(Fault::NoProgram(number, self.layout.programs.len()))
    }

    fn check_identity(&self, program: Target) -> Result<(), Fault> {
        let Some(device) = self.identity() else { return Ok(()) };
        fits((program.vendor_id, program.product_code), device)
            .map_err(|_| Fault::Identity { program, device })
    }

    /// Joins it with a program and its records in the journal.
    #[must_use]
    pub fn join(&self, first: &First) -> Image {
        let mut slots = Pieces::default();
        let [to, _] = self.layout.parameters;
        let checksum = |bytes: &[u8]| CRC.checksum(bytes);
        let header = slot(HEADER_MAGIC, journal::header(1), checksum);
        let node = self.node.map(|(id, bit_rate)| (Key::NODE, journal::node(id, bit_rate)));
        let records = node.into_iter().chain(first.more.iter().copied());
        let records = records.chain([(Key::program(first.number), first.record.value())]);
        let records = records.map(|(key, value)| slot(key.0, value, checksum));
        for (slot, at) in [header].into_iter().chain(records).zip((to.base..).step_by(SLOT_SIZE as usize)) {
            slots.extend(at, &slot.map(u32::to_le_bytes).concat(), Place::File);
        }
        // A programmer erases the sectors that it writes: no older journal must be left to count in place of this one.
        for sector in self.layout.chip.sectors().filter(|sector| sector.region.base != to.base) {
            if self.layout.parameters.iter().any(|place| place.overlaps(&sector.region)) {
                slots.add(sector.region.base, vec![0xFF; 4], Place::File);
            }
        }
        joined(&[&self.image, &slots.in_order(), &first.image])
    }
}

/// Images of different places as one.
fn joined(images: &[&Image]) -> Image {
    let mut pieces: Vec<_> = images.iter().flat_map(|image| image.runs()).collect();
    pieces.sort_by_key(|(address, _)| *address);
    let mut all = Pieces::default();
    pieces.into_iter().for_each(|(address, data)| all.extend(address, data, Place::File));
    all.in_order()
}

impl Keys {
    /// The keys in a key block; `None` if it is damaged.
    fn new(block: [u8; SIZE]) -> Option<Self> {
        // The residue of a CRC-32 over data followed by their own.
        if block[..MAGIC.len()] != MAGIC || CRC.checksum(&block) != 0x2144_DF1C {
            return None;
        }
        let keys = |from: usize, count| {
            let places = (from..).step_by(KEY).take(count).filter(|at| word(&block, *at) != 0);
            places.map(|at| array::<32>(&block, at + 4)).collect::<Vec<_>>()
        };
        let roots = keys(ROOTS, ROOT_COUNT).into_iter().map(PublicKey::new).collect::<Result<_, _>>();
        let keks = keys(KEKS, KEK_COUNT).into_iter().map(Kek::new).collect::<Result<_, _>>();
        Some(Self { roots: roots.ok()?, keks: keks.ok()?, block })
    }
}

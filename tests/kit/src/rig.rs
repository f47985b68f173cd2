//! A bootloader of any profile on one or two programs, driven through its object dictionary alone.
//!
//! Tests with this rig do not depend on the construction of the bootloader. That knowledge is in
//! [`boot`](crate::boot) and [`Rig::stored`].

use std::mem::ManuallyDrop;
use std::ops::{Deref, DerefMut};
use std::ptr::NonNull;

use boot_core::bootloader::{
    entries, entry_count, Bootloader, Choices, Config, Everything, Extras, PasswordObject,
};
use boot_core::control::{Erase, Policy, Renewal, Sealed, SealedMemory, Step};
use boot_core::decision::crash_count;
use boot_core::flash::{run, Flash};
use boot_core::policy::SealPolicy;
use boot_core::profile::Profile;
use boot_core::store::{Journal, Key, NodeParameters, Parameters};
use canopen::device::Device;
use canopen::lss::LssDevice;
use canopen::od::{Address, Entry, Objects};
use canopen::{AbortCode, BitRate, Instant, NodeId};
use shared_abi::abilities::Abilities;
use shared_abi::boot_report::BootReport;
use shared_abi::geometry::Region;
use shared_abi::label::{self, Label};
use shared_abi::layout::Layout;
use shared_abi::ram_image::Host;
use shared_abi::renewal::word;
use shared_abi::warm_start::BootRequest;

use crate::boot::{takes_sealed, Boot};
pub use crate::crc::{crc32, Crc};
use crate::ihex::intel_hex;
use crate::model::{Chip, ModelFlash, ONE_PROGRAM, TWO_PROGRAMS};
use crate::renewal::{self, loads};

// --- setups

/// The configuration of a bootloader.
pub struct Setup {
    pub name: &'static str,
    pub profile: Profile,
    pub layout: &'static Layout,
    /// Whether it takes sealed images: with the keys in its flash, these alone.
    pub takes_sealed: bool,
    pub config: Config,
}

pub const VENDOR_ID: u32 = 0x0000_0319;
pub const PRODUCT_CODE: u32 = 0x0004_0001;

static ONE: Layout = ONE_PROGRAM;
static TWO: Layout = TWO_PROGRAMS;

/// 1018h/3 of a device with sealed images: hardware revision 2.
pub const REVISION: u32 = 0x0001_0002;
/// Of its chip.
pub const UNIQUE_ID: [u8; 12] = *b"unique id 96";

const SEAL: SealPolicy = SealPolicy {
    vendor_id: VENDOR_ID,
    product_code: PRODUCT_CODE,
    revision: REVISION,
    unique_id: || UNIQUE_ID,
    ..SealPolicy::NONE
};

/// The setup of a profile, with its own object dictionary; for sealed images with the values for them.
macro_rules! setup {
    ($name:literal, $programs:literal, $layout:expr, $profile:expr) => {
        setup!($name, $programs, $layout, $profile, SealPolicy::NONE)
    };
    ($name:literal, $programs:literal, $layout:expr, $profile:expr, $seal:expr) => {{
        const PROFILE: Profile = $profile;
        static ENTRIES: [Entry; entry_count($programs, PROFILE.extras)] =
            entries($programs, PROFILE.extras).entries();
        let takes_sealed = $seal.vendor_id != 0;
        let config = config(&PROFILE, &$layout, &ENTRIES, $seal);
        Setup { name: $name, profile: PROFILE, layout: &$layout, takes_sealed, config }
    }};
}

const fn config(
    profile: &Profile,
    layout: &'static Layout,
    entries: &'static [Entry],
    seal: SealPolicy,
) -> Config {
    Config {
        entries,
        device: Device {
            device_type: profile.device_type,
            name: "rig",
            hardware_version: "0",
            software_version: "0",
            heartbeat_ms: 0,
            vendor_id: VENDOR_ID,
            product_code: PRODUCT_CODE,
            revision: seal.revision,
            serial_number: 0,
        },
        node_id: profile.node_id,
        layout,
        supports: |_| true,
        boot_up_emergency: false,
        download: Policy {
            identity: Some((VENDOR_ID, PRODUCT_CODE)),
            renewal: match (profile.extras.bootloader, seal.vendor_id) {
                (None, _) => None,
                (Some(_), 0) => Some(&RENEWAL),
                (Some(_), _) => Some(&SEALED_RENEWAL),
            },
            seal: SealPolicy { data: profile.download.data, ..seal },
            ..profile.download
        },
        password: profile.password,
    }
}

/// A renewal of the bootloader by an image of any vendor.
const RENEWAL: Renewal = Renewal { identity: None, ..renewal::RENEWAL };
const SEALED_RENEWAL: Renewal =
    Renewal { features: Abilities::RENEWAL.with(Abilities::SEALED, true), ..RENEWAL };

/// A profile with the renewal of the bootloader, which has this program number.
const fn renews(profile: Profile, number: u8) -> Profile {
    Profile { extras: Extras { bootloader: Some(number), ..profile.extras }, ..profile }
}

/// The choices of a device whose bootloader has this program number.
struct Renews<const NUMBER: u8>;

impl<const NUMBER: u8> Choices for Renews<NUMBER> {
    const EXTRAS: Extras = Extras { bootloader: Some(NUMBER), ..Everything::EXTRAS };
}

/// The standard profile with a CLEAR that erases at once.
const AT_ONCE: Profile = Profile {
    download: Policy { erase: |_| Erase::AtOnce, ..Profile::STANDARD.download },
    ..Profile::STANDARD
};

pub static STANDARD_1: Setup = setup!("STANDARD_1", 1, ONE, Profile::STANDARD);
pub static STANDARD_2: Setup = setup!("STANDARD_2", 2, TWO, Profile::STANDARD);
pub static AT_ONCE_2: Setup = setup!("AT_ONCE_2", 2, TWO, AT_ONCE);
pub static PAULUS_1: Setup = setup!("PAULUS_1", 1, ONE, Profile::PAULUS);
pub static PAULUS_2: Setup = setup!("PAULUS_2", 2, TWO, Profile::PAULUS);
pub static ESACADEMY_1: Setup = setup!("ESACADEMY_1", 1, ONE, Profile::ESACADEMY);
pub static ESACADEMY_2: Setup = setup!("ESACADEMY_2", 2, TWO, Profile::ESACADEMY);
pub static LIFT_1: Setup = setup!("LIFT_1", 1, ONE, Profile::LIFT);
pub static LIFT_2: Setup = setup!("LIFT_2", 2, TWO, Profile::LIFT);

/// Devices that can be renewed. Data of a lift are a program, too, and the bootloader follows them.
pub static RENEWALS: [Setup; 10] = [
    setup!("RENEWS_STANDARD_1", 1, renewal::LAYOUT, renews(Profile::STANDARD, 2)),
    setup!("RENEWS_STANDARD_2", 2, renewal::TWO, renews(Profile::STANDARD, 3)),
    setup!("RENEWS_AT_ONCE_2", 2, renewal::TWO, renews(AT_ONCE, 3)),
    setup!("RENEWS_PAULUS_1", 1, renewal::LAYOUT, renews(Profile::PAULUS, 2)),
    setup!("RENEWS_ESACADEMY_1", 1, renewal::LAYOUT, renews(Profile::ESACADEMY, 2)),
    setup!("RENEWS_ESACADEMY_2", 2, renewal::TWO, renews(Profile::ESACADEMY, 3)),
    setup!("RENEWS_LIFT_1", 1, renewal::LAYOUT, renews(Profile::LIFT, 3)),
    setup!("RENEWS_LIFT_2", 2, renewal::TWO, renews(Profile::LIFT, 3)),
    setup!("RENEWS_SEALED_STANDARD_2", 2, renewal::TWO, renews(Profile::STANDARD, 3), SEAL),
    setup!("RENEWS_SEALED_LIFT_1", 1, renewal::LAYOUT, renews(Profile::LIFT, 3), SEAL),
];

/// A device that can be renewed with a journal as large as on a chip.
pub static LARGE_JOURNAL: Setup =
    setup!("LARGE_JOURNAL", 2, renewal::LARGE_JOURNAL, renews(Profile::STANDARD, 3));

/// Devices with sealed images.
pub mod sealed {
    use super::*;

    pub static STANDARD_1: Setup = setup!("STANDARD_1", 1, ONE, Profile::STANDARD, SEAL);
    pub static STANDARD_2: Setup = setup!("STANDARD_2", 2, TWO, Profile::STANDARD, SEAL);
    /// A product with a lowest counter of 6 in its bootloader.
    pub static CONSTANT_1: Setup =
        setup!("CONSTANT_1", 1, ONE, Profile::STANDARD, SealPolicy { counter: 6, ..SEAL });
    const CONFIRMED: SealPolicy = SealPolicy { counter_with_confirmation: true, ..SEAL };
    /// A product that raises the counter at the confirmation of a program.
    pub static CONFIRMED_1: Setup = setup!("CONFIRMED_1", 1, ONE, Profile::STANDARD, CONFIRMED);
    pub static CONFIRMED_2: Setup = setup!("CONFIRMED_2", 2, TWO, Profile::STANDARD, CONFIRMED);
    /// A password for each program, which makes it invalid; the program starts by itself.
    pub static ESACADEMY_2: Setup = setup!("ESACADEMY_2", 2, TWO, Profile::ESACADEMY, SEAL);
    /// A password, and program 2 is data.
    pub static LIFT_2: Setup = setup!("LIFT_2", 2, TWO, Profile::LIFT, SEAL);
}

impl Setup {
    /// What its resident part has for a RAM image.
    pub fn host(&self) -> Host {
        let features = self.config.download.renewal.map_or(Abilities::NONE, |renewal| renewal.features);
        Host { features, ..renewal::HOST }
    }

    pub fn programs(&self) -> u8 {
        self.layout.programs.len() as u8
    }

    /// Whether there is a program with this number.
    pub fn has(&self, program: u8) -> bool {
        (1..=self.programs()).contains(&program)
    }

    pub fn region(&self, program: u8) -> Region {
        self.layout.programs[usize::from(program) - 1]
    }

    /// Whether a program number is for data of the application.
    pub fn is_data(&self, program: u8) -> bool {
        self.profile.download.data == Some(program)
    }

    /// Whether the password of a program makes it invalid, as CLEAR does.
    pub fn password_clears(&self) -> bool {
        matches!(self.profile.extras.password, PasswordObject::EnableFlash)
    }

    /// The object for a program's password, and the password.
    pub fn password(&self, program: u8) -> Option<(Address, &'static [u8])> {
        let at = match self.profile.extras.password {
            PasswordObject::None => return None,
            PasswordObject::EnableFlash => Address::new(0x7F50, program),
            PasswordObject::Unlock => Address::new(0x6005, 1),
        };
        Some((at, self.profile.password))
    }
}

// --- the device

/// The parts of a bootloader that the rest of the device uses.
pub trait Node: Objects + LssDevice {
    /// Runs one bounded step; returns whether there was no work.
    fn is_idle_after_step(&mut self) -> bool;
    fn is_finishing(&mut self) -> bool;
    fn take_boot_request(&mut self) -> Option<BootRequest>;
    fn confirm(&mut self, program: u8);
    fn set_time(&mut self, now: Instant);
}

impl<F: Flash, P: Parameters, const PROGRAMS: usize, C: Choices> Node for Bootloader<'_, F, P, PROGRAMS, C> {
    fn is_idle_after_step(&mut self) -> bool {
        self.step() == Step::Idle
    }

    fn is_finishing(&mut self) -> bool {
        Bootloader::is_finishing(self)
    }

    fn take_boot_request(&mut self) -> Option<BootRequest> {
        Bootloader::take_boot_request(self)
    }

    fn confirm(&mut self, program: u8) {
        Bootloader::confirm(self, program);
    }

    fn set_time(&mut self, now: Instant) {
        Bootloader::set_time(self, now);
    }
}

/// What a host does with the objects of any bootloader.
impl dyn Node + '_ {
    /// Runs until there is no work.
    pub fn settle(&mut self) {
        assert!(self.settles(), "the work does not end");
    }

    /// The same; returns whether the work ended.
    pub fn settles(&mut self) -> bool {
        (0..400_000).any(|_| self.is_idle_after_step())
    }

    pub fn steps(&mut self, steps: u32) {
        for _ in 0..steps {
            self.is_idle_after_step();
        }
    }

    pub fn word(&mut self, index: u16, sub: u8) -> u32 {
        let mut bytes = [0; 4];
        self.read(Address::new(index, sub), &mut bytes).expect("the object can be read");
        u32::from_le_bytes(bytes)
    }

    /// 1F51h: 0 stopped, 3 no program.
    pub fn state(&mut self, program: u8) -> u32 {
        self.word(0x1F51, program)
    }

    /// 1F56h.
    pub fn identification(&mut self, program: u8) -> u32 {
        self.word(0x1F56, program)
    }

    /// 1F57h.
    pub fn status(&mut self, program: u8) -> u32 {
        self.word(0x1F57, program)
    }

    /// 1F51h, without waiting for the result.
    pub fn command(&mut self, program: u8, command: u8) -> Result<(), AbortCode> {
        self.write(Address::new(0x1F51, program), &[command])
    }

    /// Ends a download without waiting for the result.
    pub fn end(&mut self, program: u8) -> Result<(), AbortCode> {
        self.download_end(Address::new(0x1F50, program))
    }

    /// Ends a transfer as an SDO abort does.
    pub fn cancel(&mut self, program: u8) {
        self.download_cancel(Address::new(0x1F50, program));
    }
}

/// Sends more bytes of a transfer to 1F50h in pieces of this size, and waits for room. An error ends the transfer,
/// as in the SDO server.
pub fn go_on(
    node: &mut (impl Node + ?Sized),
    program: u8,
    data: &[u8],
    piece: usize,
) -> Result<(), AbortCode> {
    let at = Address::new(0x1F50, program);
    for bytes in data.chunks(piece) {
        while node.download_space(at, false) < bytes.len() {
            assert!(!node.is_idle_after_step(), "there is never room");
        }
        node.download_data(at, bytes).inspect_err(|_| node.download_cancel(at))?;
    }
    Ok(())
}

/// Stores so many values, as the boot stage does when it counts resets, so that the journal fills.
pub fn fill_journal(flash: &mut impl Flash, layout: &Layout, stores: u32) {
    let mut journal = Journal::open(flash, layout.parameters);
    for count in (0..stores).rev() {
        journal.store(Key::CRASH_COUNT, [count, 0, 0, 0]);
        run(flash, |flash, outcome| journal.next(flash, outcome)).expect("it is stored");
    }
}

/// The stored state that would be found after a reset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stored {
    /// By program, from 1 on: size, CRC, signed, version.
    pub records: [Option<(u32, u32, bool, u32)>; 2],
    pub node: NodeParameters,
}

/// A bootloader with the memory that it borrows: a device that makes many resets has one at a time.
pub struct Owned {
    /// It is dropped before its memory.
    node: ManuallyDrop<Box<dyn Node>>,
    memory: NonNull<(Vec<u8>, SealedMemory)>,
}

#[allow(unsafe_code, reason = "a bootloader and what it borrows are kept together")]
impl Owned {
    /// The bootloader that `boot` makes with a buffer of this size and, if `is_sealed`, with the
    /// memory for sealed images.
    pub fn new(
        buffer: usize,
        is_sealed: bool,
        boot: impl for<'m> FnOnce(&'m mut [u8], Sealed<'m>) -> Box<dyn Node + 'm>,
    ) -> Self {
        let mut memory = NonNull::from(Box::leak(Box::new((vec![0; buffer], SealedMemory::default()))));
        // SAFETY: it was just made, and nothing else refers to it before `drop`.
        let (buffer, room) = unsafe { memory.as_mut() };
        let sealed = if is_sealed || takes_sealed() { room.sealed() } else { Sealed::NONE };
        Self { node: ManuallyDrop::new(boot(buffer, sealed)), memory }
    }
}

#[allow(unsafe_code, reason = "a bootloader and what it borrows are kept together")]
impl Drop for Owned {
    fn drop(&mut self) {
        // SAFETY: `node` is not used after this.
        unsafe { ManuallyDrop::drop(&mut self.node) };
        // SAFETY: it came from a box, and `node` had the only references to it: `boot`, which is
        // good for any lifetime, cannot have kept one.
        drop(unsafe { Box::from_raw(self.memory.as_ptr()) });
    }
}

impl Deref for Owned {
    type Target = dyn Node;

    fn deref(&self) -> &Self::Target {
        &**self.node
    }
}

impl DerefMut for Owned {
    fn deref_mut(&mut self) -> &mut Self::Target {
        &mut **self.node
    }
}

/// A device: its flash, and the bootloader that runs on it.
pub struct Rig {
    pub setup: &'static Setup,
    pub chip: Chip,
    pub node: Owned,
    buffer: usize,
}

impl Deref for Rig {
    type Target = dyn Node;

    fn deref(&self) -> &Self::Target {
        &*self.node
    }
}

impl DerefMut for Rig {
    fn deref_mut(&mut self) -> &mut Self::Target {
        &mut *self.node
    }
}

pub const BOARD_NODE: NodeParameters = NodeParameters { id: NodeId::new(5), bit_rate: BitRate::K125 };

impl Rig {
    /// A device with empty flash, and a buffer of this size for blocks.
    pub fn new(setup: &'static Setup, buffer: usize) -> Self {
        Self::on(setup, buffer, ModelFlash::new(setup.layout.chip))
    }

    /// A device with this flash.
    pub fn on(setup: &'static Setup, buffer: usize, flash: ModelFlash) -> Self {
        let chip = Chip::new(flash);
        let node = Self::boot(setup, &chip, buffer, None);
        Self { setup, chip, node, buffer }
    }

    fn boot(setup: &'static Setup, chip: &Chip, buffer: usize, request: Option<BootRequest>) -> Owned {
        let flash = chip.clone();
        let parameters = Journal::open(&flash, setup.layout.parameters);
        let node = NodeParameters::load(&parameters, &flash, BOARD_NODE, |_| true);
        let mut boot = Boot::new(&setup.config, node);
        boot.report.crash_resets = crash_count(&parameters, &flash) as u8;
        let number = setup.profile.extras.bootloader;
        if number.is_some() {
            let loaded = loads(&flash, setup.layout, setup.host(), request);
            let (_, origin, trial_end) = loaded.expect("a bootloader can be loaded");
            boot.report = BootReport { renewal: word(origin, trial_end), ..boot.report };
        }
        Owned::new(buffer, setup.takes_sealed, |buffer, sealed| match (setup.programs(), number) {
            (1, None) => Box::new(boot.with::<_, _, 1, Everything>(parameters, flash, buffer, sealed)),
            (2, None) => Box::new(boot.with::<_, _, 2, Everything>(parameters, flash, buffer, sealed)),
            (1, Some(2)) => Box::new(boot.with::<_, _, 2, Renews<2>>(parameters, flash, buffer, sealed)),
            (1, Some(3)) => Box::new(boot.with::<_, _, 2, Renews<3>>(parameters, flash, buffer, sealed)),
            (2, Some(3)) => Box::new(boot.with::<_, _, 3, Renews<3>>(parameters, flash, buffer, sealed)),
            _ => unreachable!(),
        })
    }

    /// The state that a reset would find now, from a copy of the flash.
    pub fn stored(&self) -> Stored {
        let mut flash = self.chip.model().clone();
        flash.power_on();
        let layout = self.setup.layout;
        let parameters = Journal::open(&flash, layout.parameters);
        let record = |program| {
            if program > self.setup.programs() {
                return None;
            }
            let record = parameters.program(&flash, program)?;
            Some((record.size, record.crc, record.signed, record.version))
        };
        Stored {
            records: [record(1), record(2)],
            node: NodeParameters::load(&parameters, &flash, BOARD_NODE, |_| true),
        }
    }

    /// A reset: a running flash operation ends there.
    pub fn reset(&mut self) {
        self.reset_for(None);
    }

    /// The same with a request to the resident part.
    pub fn reset_for(&mut self, request: Option<BootRequest>) {
        self.chip.model().power_on();
        self.node = Self::boot(self.setup, &self.chip, self.buffer, request);
    }

    /// A command that is taken, with all work.
    #[track_caller]
    pub fn work(&mut self, program: u8, command: u8) {
        self.command(program, command).expect("the command is taken");
        self.settle();
    }

    /// CLEAR.
    #[track_caller]
    pub fn clear(&mut self, program: u8) {
        self.work(program, 3);
    }

    /// The right password, which is taken, with all work.
    #[track_caller]
    pub fn open(&mut self, program: u8) {
        self.unlock(program).expect("the password is right");
        self.settle();
    }

    /// Downloads of one program, one after another, which are taken, with all work.
    #[track_caller]
    pub fn send_all<B: AsRef<[u8]>>(&mut self, program: u8, downloads: impl IntoIterator<Item = B>) {
        for data in downloads {
            self.send(program, data.as_ref()).expect("good data are taken");
            self.settle();
        }
    }

    /// The right password, if there is one.
    pub fn unlock(&mut self, program: u8) -> Result<(), AbortCode> {
        match self.setup.password(program) {
            Some((at, password)) => self.node.write(at, password),
            None => Ok(()),
        }
    }

    /// Begins a download and sends these bytes of it.
    pub fn begin(&mut self, program: u8, size: Option<u32>, data: &[u8]) -> Result<(), AbortCode> {
        self.node.download_start(Address::new(0x1F50, program), size)?;
        go_on(&mut *self.node, program, data, 7)
    }

    /// A whole download, without waiting for the remaining work.
    pub fn send(&mut self, program: u8, data: &[u8]) -> Result<(), AbortCode> {
        self.begin(program, Some(data.len() as u32), data)?;
        self.end(program)
    }

    /// Password or CLEAR, and a program in one download, with all work; a resulting request to
    /// start it is discarded.
    pub fn install(&mut self, program: u8, data: &[u8]) {
        self.unlock(program).expect("the password is right");
        if self.setup.password(program).is_none() {
            self.clear(program);
        }
        self.send_all(program, [data]);
        assert_eq!((self.status(program), self.state(program)), (0, 0));
        self.node.take_boot_request();
    }

    /// Password or CLEAR, and a program in one download, which may be refused, with all work; the status that it
    /// comes to.
    pub fn status_of(&mut self, program: u8, data: &[u8]) -> u32 {
        if self.setup.password(program).is_some() {
            self.open(program);
        } else {
            self.command(program, 3).expect("CLEAR is taken");
        }
        let _ = self.send(program, data);
        self.settle();
        self.status(program)
    }

    /// After a reset, a program is installed as it was, by its CRC, and can be started.
    pub fn assert_installed(&mut self, program: u8, image: &[u8], what: &str) {
        self.reset();
        assert_eq!(self.identification(program), crc32(image), "{what}");
        self.command(program, 1).expect("START is taken");
        let request = self.node.take_boot_request();
        assert!(
            matches!(request, Some(BootRequest::Start(of) | BootRequest::Trial(of)) if of == program),
            "{what}: {request:?}"
        );
        self.reset();
    }

    /// The contents of a program's flash, as seen by a debug probe.
    pub fn cells(&self, program: u8) -> Vec<u8> {
        self.chip.model().cells(self.setup.region(program)).to_vec()
    }

    /// The length of the part of a program's flash, from its start, with the CRC in 1F56h; `None`
    /// if no length matches: then the record is wrong.
    pub fn size_by_crc(&mut self, program: u8) -> Option<u32> {
        let identification = self.identification(program);
        let cells = self.cells(program);
        let mut crc = Crc::new();
        (1..).zip(&cells).find_map(|(len, byte)| {
            crc.push(*byte);
            (crc.value() == identification).then_some(len)
        })
    }

    /// Whether a program is missing, or matches its record.
    pub fn is_true(&mut self, program: u8) -> bool {
        self.state(program) == 3 || self.size_by_crc(program).is_some()
    }
}

// --- programs and how they are sent

/// A program for this region and product: vectors, a label, and distinct bytes.
pub fn program(region: Region, product_code: u32, len: usize, seed: u8) -> Vec<u8> {
    let mut bytes: Vec<u8> = (0..len).map(|i| (i as u8).wrapping_mul(31) ^ (i >> 8) as u8 ^ seed).collect();
    bytes[..4].copy_from_slice(&0x2001_FFC0_u32.to_le_bytes());
    bytes[4..8].copy_from_slice(&(region.base + 0x101).to_le_bytes());
    let at = label::OFFSET as usize;
    if len >= at + label::SIZE {
        bytes[at..at + label::SIZE].copy_from_slice(&Label::new(VENDOR_ID, product_code, seed.into()).emit());
    }
    bytes
}

/// A program for this number of a setup.
pub fn image(setup: &Setup, number: u8, len: usize, seed: u8) -> Vec<u8> {
    program(setup.region(number), PRODUCT_CODE, len, seed)
}

/// The same with the number as the seed, and the version.
pub fn raw(setup: &Setup, number: u8, len: usize) -> Vec<u8> {
    image(setup, number, len, number)
}

pub fn block(number: u32, address: u32, data: &[u8]) -> Vec<u8> {
    let mut bytes = words(&[number, address, data.len() as u32]);
    bytes.extend(data);
    bytes.extend(crc32(&bytes).to_le_bytes());
    bytes
}

/// A program in blocks, with one block of data.
pub fn blocks(base: u32, program: &[u8]) -> [Vec<u8>; 3] {
    let end = words(&[program.len() as u32, crc32(program)]);
    [block(0, 0, &[0; 8]), block(1, base, program), block(u32::MAX, 0, &end)]
}

pub fn words(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

/// A program as Intel HEX, 16 bytes a record.
pub fn hex(base: u32, program: &[u8]) -> Vec<u8> {
    intel_hex(base, program).into_bytes()
}

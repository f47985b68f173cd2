//! The choices that a product has. A product makes them in its file, `products/default.rs`.
//!
//! A library of its own: the resident part and the RAM image are both built from it, and the tests on the
//! host read it. Names in brackets are those of the
//! SYS TEC manual (L-1112d_10, chapter 4.8). If choices contradict each other, the build fails with
//! the names of the choices.
#![no_std]

use core::ops::RangeInclusive;

// What the fields of a product are made of: its file has them by `use super::*`.
pub use boot_core::canopen::{BitRate, NodeId};
pub use boot_core::control::{AppInfo, Erase, Verdict};
pub use boot_core::crc::CrcKind;
pub use boot_core::decision::Autostart;
pub use boot_core::profile::Profile;

use boot_core::bootloader::{Extras, PasswordObject};
use boot_core::canopen::program::ProgramStart;
use boot_core::canopen::AbortCode;
use boot_core::control::{Policy, Renewal};
use boot_core::decision;
use boot_core::flash::Flash;
use boot_core::policy::SealPolicy;
use boot_core::store::{Journal, NodeParameters};
use bsp::line::TIMINGS;
use bsp::{BIT_RATE, IDENTITY, LAYOUT, NODE_ID};
use shared_abi::abilities::Abilities;
use shared_abi::nameplate::Nameplate;
use shared_abi::renewal;
use shared_abi::services::Facts;
use shared_abi::warm_start::Cell;

// The file of this product, as the module `chosen`, with its name, and the identity of the board (build.rs).
include!(concat!(env!("OUT_DIR"), "/product.rs"));
include!(concat!(env!("OUT_DIR"), "/board_identity.rs"));

/// Whether the bootloader takes sealed images.
pub const SEALED: bool = cfg!(feature = "sealed");

/// The abilities of the resident part, which the RAM image needs.
pub const ABILITIES: Abilities = Abilities::NONE
    .with(Abilities::SEALED, SEALED)
    .with(Abilities::RENEWAL, PRODUCT.renewal)
    .with(Abilities::ROM_LOADER, PRODUCT.rom_loader)
    .with(Abilities::NAMEPLATE, HAS_NAMEPLATE);

/// What a device does while its crystal fails. It then runs from HSI, which may be wrong by 4 % and more
/// (DS8626 table 41), and CAN tolerates 0.3 to 1 %: such a node destroys the frames of the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CrystalFailure {
    /// It listens, until a request of the layer setting services (LSS) arrives without an error: then its
    /// clock is good enough, and it takes part.
    Silent,
    /// It takes part at once. Bit 7 of the reason in its emergency says so.
    RunFromHsi,
}

/// The choices of a product.
#[derive(Clone, Debug)]
pub struct Product {
    /// The dialect of the product, where dialects contradict each other (docs/dialects.md).
    pub profile: Profile,
    /// The programs that start by themselves after a reset, the preferred one first: the device starts the
    /// first one that is valid, released and allowed. An empty list for a device that waits for 1F51h = 1
    /// (`BLCOP_USE_AUTOSTART_APP`). Programs count from 1, as sub-indices do: the manual's
    /// `BLCOP_APP_START_INDEX` = 0 is program 1 here.
    pub autostart: Autostart,
    /// The number of unrequested resets of the application in a row after which the device stays in
    /// the bootloader, 1 to 255.
    pub max_crash_resets: u32,
    /// How long a program that was never confirmed is held back before it starts by itself, in ms.
    /// In this time an SDO request to the node or any layer setting service keeps the device in the
    /// bootloader. 0 for no such window.
    pub rescue_window_ms: u16,
    /// The same for a confirmed program.
    pub rescue_window_confirmed_ms: u16,
    /// Whether two resets by the NRST pin within half a second keep the device in the bootloader: an entry
    /// without a pin of its own. A program then starts half a second later after such a reset.
    pub two_resets: bool,
    /// Whether a command over CAN (2008h) starts the loader in the ROM of the chip, ST's own. Who may write a
    /// program may then do anything with the device: not with the feature `sealed`.
    pub rom_loader: bool,
    /// Node-IDs with which programs may be started (`BLCOP_MIN_NODEID`, `BLCOP_MAX_NODEID`).
    pub node_ids: RangeInclusive<u8>,
    /// Bit rates that the device may be set to, as indices of CiA 305 table 1: 0 for 1 Mbit/s to 8
    /// for 10 kbit/s (`BLCOP_MIN_BAUIDX`, `BLCOP_MAX_BAUIDX`).
    pub bit_rates: RangeInclusive<u8>,
    /// The source of node-ID and bit rate (`TgtGetNodeId`).
    pub node_source: NodeSource,
    /// Whether the node sends a boot-up message (`BLCOP_SEND_BOOTUP`).
    pub boot_up_message: bool,
    /// What the device does when its crystal fails, and the clock of its CAN controller may be wrong.
    pub crystal_failure: CrystalFailure,
    /// Base of the COB-ID of SDO requests; the node-ID is added (`BLCOP_BASE_REQUEST`). With each of
    /// `node_ids` it must be no reserved COB-ID (CiA 301 clause 7.3.5), and one that the predefined connection set
    /// has for nothing else than SDO or PDOs (7.3.3): no node of the bus may then use that PDO.
    pub sdo_request_base: u16,
    /// Base of the COB-ID of SDO answers; the node-ID is added (`BLCOP_BASE_RESPONSE`). The same applies.
    pub sdo_response_base: u16,
    /// Whether the device may detect the bit rate by listening, if none is stored or set; on boards with the
    /// split map alone.
    pub auto_bit_rate: bool,
    /// Whether an emergency follows each boot-up. It shows a master that the bootloader runs, and
    /// not the application.
    pub boot_up_emergency: bool,
    /// Period of the heartbeat (1017h, which is constant), in ms; 0 for none.
    pub heartbeat_ms: u16,
    /// Whether the device supports layer setting services (LSS, CiA 305); on boards with the compact map
    /// without a profile that has a password.
    pub lss: bool,
    /// Whether the device starts in LSS configuration state, for a bus with one device to
    /// configure.
    pub lss_start_in_configuration: bool,
    /// Whether the device reports a missing node-ID by "non-configured slave".
    pub lss_announce: bool,
    /// Whether LSS masters find the device by ranges of its address (identify remote slave, 46h to 4Bh), besides
    /// fastscan; on boards with the split map alone.
    pub lss_identify: bool,
    /// Whether LSS may store node-ID and bit rate.
    pub lss_store: bool,
    /// Whether programs can be written by SDO block download. Without it the device answers 05040001h, and
    /// a master goes on in segments, which takes two to three times as long (`SDO_BLOCKTRANSFER`). On boards with the
    /// compact map the dialects of Paulus and ESAcademy have none.
    pub block_download: bool,
    /// The segments of a sub-block of a block download at most, 1 to 127; at low bit rates the device takes
    /// fewer (`SDO_BLOCKSIZE_DOWNLOAD`).
    pub segments_per_sub_block: u8,
    /// Received frames that may wait for the protocol, 8 to 255 (`CDRV_MAX_RX_BUFF_ENTRIES_LOW`).
    pub receive_queue: u8,
    /// Whether objects can be read by SDO block upload; on boards with the split map alone.
    pub block_upload: bool,
    /// Whether there is a second SDO server (1201h), by which one client writes a program to several
    /// devices at once; on boards with the split map alone.
    pub second_server: bool,
    /// Whether a download of block files that was cut off can go on where it stopped (2006h); on boards
    /// with the split map alone.
    pub resume: bool,
    /// Whether programs can be read where the dialect says so, and 100Ah is the version of the stored
    /// program; on boards with the split map alone.
    pub read_back: bool,
    /// Whether date and time of the program can be read (1F52h), in the bootloader and in the program; on
    /// boards with the split map alone.
    pub program_date: bool,
    /// Whether programs are taken as Intel HEX, too; on boards with the compact map in ESAcademy's profile
    /// alone.
    pub intel_hex: bool,
    /// Where vendor-ID, product code, revision and serial number (1018h) come from
    /// (`BLCOP_IDENTITY_VENDORID` to `BLCOP_IDENTITY_SERIALNR`).
    pub identity: IdentitySource,
    /// Whether vendor-ID and product code of a program must be the device's
    /// (`BLCOP_IDENTITY_CHECK`).
    pub identity_check: bool,
    /// The product's own check of block 0 and of the label in the image (`TgtProcessAppInfoData`).
    pub check: fn(program: u8, info: &AppInfo<'_>) -> Verdict,
    /// Whether programs may be changed now.
    pub programming_allowed: fn() -> bool,
    /// The time of the erase for CLEAR of a program (`TgtCheckEraseApp`); `None` for the profile's.
    pub erase: Option<fn(program: u8) -> Erase>,
    /// Whether a signed program may be started now: for instance a function that reads a port pin
    /// (`TgtCheckAppSig`). It runs in the boot stage, before any peripheral is set up, and must
    /// leave the peripherals that it uses as after a reset ([`bsp::inputs`] does).
    pub start_allowed: fn(program: u8) -> bool,
    /// The CRC of blocks and programs (`BLCOP_USE_CRC16`); CRC-16 on boards with the split map alone.
    pub crc: CrcKind,
    /// Bytes of flash that one step of a CRC covers, 64 to 65536. Other work of the same priority
    /// waits for one step at most (`BLCOP_MAX_CRC_STEP_SIZE`).
    pub crc_step: u32,
    /// Size of the buffer for blocks that wait for the flash, in bytes: 1024 up to the free RAM
    /// (`BLCOP_MAX_PROGRAM_BUFFER`). While a sector of 128 KiB is erased, a bus at 1 Mbit/s
    /// delivers some 55 KiB.
    pub block_buffer: usize,
    /// The longest time without a check-in of a task of the bootloader before the watchdog resets
    /// the chip, in ms, 250 to 4000: it runs while a crystal that does not start is waited for. `None` for no
    /// watchdog (`BLCOP_USE_WATCHDOG`).
    pub watchdog_ms: Option<u16>,
    /// The time within which a program must feed the independent watchdog, from its first
    /// instruction on, in ms, 1 to 4000; `None` to start programs without the watchdog.
    pub program_watchdog_ms: Option<u16>,
    /// How long the device waits for its reset after the answer is on the bus, in ms, 10 to 1000:
    /// clients expect to see the answer first. With 15 the bus is silent for less than 25 ms in a restart.
    pub answer_to_reset_ms: u32,
    /// The lowest accepted security counter of a sealed image, whatever is stored (feature
    /// `sealed`).
    pub security_counter: u32,
    /// Whether the security counter is raised when a program is confirmed, instead of when it is
    /// installed (feature `sealed`).
    pub counter_with_confirmation: bool,
    /// The bytes of the resident part that was released with the product's devices, usually by
    /// `include_bytes!`; the RAM image is then built for it. `None` for a fresh one. The choices in
    /// [`FACTS`] must be the same.
    pub resident: Option<&'static [u8]>,
    /// Whether the bootloader itself can be renewed over CAN (docs/renewal.md); on boards whose layout
    /// has `staging` alone.
    pub renewal: bool,
    /// The time within which a master must confirm a new bootloader on trial, in seconds, 1 to 3600.
    pub renewal_s: u16,
    /// The security counter of this bootloader (feature `sealed`): a device takes a new one only with a
    /// higher counter.
    pub bootloader_counter: u32,
    /// The hardware revisions on which this bootloader runs: bit n for revision numbers (1018h/3) with n in
    /// the five lowest bits; 0 for all.
    pub bootloader_revisions: u32,
}

impl Product {
    /// A product with no choice of its own.
    pub const DEFAULT: Self = Self {
        profile: Profile::STANDARD,
        autostart: Autostart::InOrder,
        max_crash_resets: 3,
        rescue_window_ms: 300,
        rescue_window_confirmed_ms: 0,
        two_resets: false,
        rom_loader: false,
        node_ids: 1..=127,
        bit_rates: 0..=8,
        node_source: NodeSource::Stored,
        boot_up_message: true,
        crystal_failure: CrystalFailure::Silent,
        sdo_request_base: 0x600,
        sdo_response_base: 0x580,
        auto_bit_rate: LAYOUT.home.is_some(),
        boot_up_emergency: true,
        heartbeat_ms: 1000,
        lss: true,
        lss_start_in_configuration: false,
        lss_announce: false,
        lss_identify: LAYOUT.home.is_some(),
        lss_store: true,
        block_download: true,
        segments_per_sub_block: 127,
        receive_queue: 32,
        block_upload: LAYOUT.home.is_some(),
        second_server: LAYOUT.home.is_some(),
        resume: LAYOUT.home.is_some(),
        read_back: LAYOUT.home.is_some(),
        program_date: LAYOUT.home.is_some(),
        intel_hex: LAYOUT.home.is_some(),
        identity: IdentitySource::Board,
        identity_check: true,
        check: |_, _| Verdict::Standard,
        programming_allowed: || true,
        erase: None,
        start_allowed: |_| true,
        crc: CrcKind::Crc32,
        crc_step: 1024,
        block_buffer: if SEALED { 48 } else { 80 } * 1024,
        watchdog_ms: Some(1000),
        program_watchdog_ms: None,
        answer_to_reset_ms: 15,
        security_counter: 0,
        counter_with_confirmation: false,
        resident: None,
        renewal: LAYOUT.staging.is_some(),
        renewal_s: 60,
        bootloader_counter: 0,
        bootloader_revisions: 0,
    };

    /// A product whose only choice is its dialect. On the compact map a dialect has what its manual has:
    /// ESAcademy's has Intel HEX, it and Paulus' have no SDO block transfer; ESAcademy's nodes and lifts have a node-ID
    /// of their own, and no LSS.
    pub const fn of(profile: Profile) -> Self {
        let lss = LAYOUT.home.is_some() || !profile.download.locked;
        Self {
            lss,
            // A silent device waits for LSS.
            crystal_failure: if lss { CrystalFailure::Silent } else { CrystalFailure::RunFromHsi },
            block_download: LAYOUT.home.is_some() || has_block_transfer(&profile),
            intel_hex: LAYOUT.home.is_some() || sends_hex(&profile),
            profile,
            ..Self::DEFAULT
        }
    }

    /// Returns the product if its choices are consistent; otherwise it fails the build with the
    /// message of the broken rule.
    pub const fn checked(self) -> Self {
        if let Autostart::List(list) = self.autostart {
            let mut at = 0;
            while at < list.len() {
                assert!(
                    list[at] != 0,
                    "product: autostart counts programs from 1; BLCOP_APP_START_INDEX = 0 is program 1"
                );
                assert!(
                    list[at] as usize <= LAYOUT.programs.len(),
                    "product: autostart names a program that the layout has not"
                );
                assert!(
                    !matches!(self.profile.download.data, Some(data) if data == list[at]),
                    "product: autostart names the profile's data, which are no program"
                );
                let mut other = 0;
                while other < at {
                    assert!(list[other] != list[at], "product: autostart names a program twice");
                    other += 1;
                }
                at += 1;
            }
        }
        assert!(!SEALED || matches!(self.crc, CrcKind::Crc32), "product: a sealed image carries a CRC-32");
        assert!(
            LAYOUT.home.is_some() || matches!(self.crc, CrcKind::Crc32),
            "product: CrcKind::Crc16 needs the split map: the compact one has no room for it"
        );
        assert!(
            LAYOUT.home.is_some() || !self.block_download || has_block_transfer(&self.profile),
            "product: block_download needs the split map in the profiles PAULUS and ESACADEMY; Product::of(profile) has \
             what fits"
        );
        assert!(
            self.block_download || !self.second_server,
            "product: second_server needs block_download, by which a group gets its data"
        );
        assert!(
            LAYOUT.home.is_some()
                || !(self.block_upload
                    || self.second_server
                    || self.resume
                    || self.read_back
                    || self.program_date
                    || self.auto_bit_rate
                    || self.lss_identify),
            "product: block_upload, second_server, resume, read_back, program_date, auto_bit_rate and lss_identify \
             need the split map: the compact one has no room for them"
        );
        assert!(
            self.lss || matches!(self.crystal_failure, CrystalFailure::RunFromHsi),
            "product: a device without lss cannot wait for it: crystal_failure must be RunFromHsi"
        );
        assert!(
            !(SEALED && self.rom_loader),
            "product: rom_loader would write any program into a device that takes sealed images"
        );
        assert!(
            self.segments_per_sub_block >= 1 && self.segments_per_sub_block <= 127,
            "product: segments_per_sub_block must be 1 to 127"
        );
        assert!(self.receive_queue >= 8, "product: receive_queue must be 8 or more");
        assert!(self.max_crash_resets >= 1, "product: max_crash_resets must be 1 or more");
        assert!(
            self.max_crash_resets <= 255,
            "product: max_crash_resets must be 255 or less: each crash is counted in the flash"
        );
        let window = if self.rescue_window_ms > self.rescue_window_confirmed_ms {
            self.rescue_window_ms
        } else {
            self.rescue_window_confirmed_ms
        };
        assert!(
            window == 0 || self.autostart.is_on(),
            "product: a rescue window needs autostart: without it no program starts by itself"
        );
        assert!(
            self.heartbeat_ms == 0 || window < self.heartbeat_ms,
            "product: the rescue window must be shorter than the heartbeat period"
        );
        assert!(
            *self.node_ids.start() >= 1
                && *self.node_ids.end() <= 127
                && *self.node_ids.start() <= *self.node_ids.end(),
            "product: node_ids must be a range within 1 to 127"
        );
        assert!(
            *self.bit_rates.end() <= 8 && *self.bit_rates.start() <= *self.bit_rates.end(),
            "product: bit_rates must be a range within 0 to 8"
        );
        let (request, response) = (self.sdo_request_base, self.sdo_response_base);
        assert!(
            request >= 0x80 && request <= 0x780 && response >= 0x80 && response <= 0x780,
            "product: sdo_request_base and sdo_response_base must be 80h to 780h"
        );
        assert!(
            request.abs_diff(response) >= 0x80,
            "product: sdo_request_base and sdo_response_base must be 80h or more apart"
        );
        assert!(
            request.abs_diff(0x700) >= 0x80 && response.abs_diff(0x700) >= 0x80,
            "product: the COB-IDs of SDO must not be those of boot-up and heartbeat (700h)"
        );
        assert!(
            !is_taken(request, 0x600, &self),
            "product: sdo_request_base plus one of node_ids is a COB-ID of another service (CiA 301: 000h to 180h, \
             580h to 67Fh, 6E0h to 7FFh): take 600h, or a base from 180h to 500h, or 680h up to node 95"
        );
        assert!(
            !is_taken(response, 0x580, &self),
            "product: sdo_response_base plus one of node_ids is a COB-ID of another service (CiA 301: 000h to 180h, \
             580h to 67Fh, 6E0h to 7FFh): take 580h, or a base from 180h to 500h, or 680h up to node 95"
        );
        self.check_board_node();
        assert!(self.crc_step >= 64, "product: crc_step must be 64 bytes or more");
        assert!(
            self.crc_step <= 64 * 1024,
            "product: crc_step must be 65536 bytes or less: the watchdog waits for a step"
        );
        assert!(
            self.block_buffer >= 1024 && self.block_buffer < LAYOUT.ram.size as usize,
            "product: block_buffer must be 1024 bytes or more, and fit the RAM"
        );
        if let Some(ms) = self.watchdog_ms {
            assert!(ms >= 250 && ms <= 4000, "product: watchdog_ms must be 250 to 4000");
        }
        if let Some(ms) = self.program_watchdog_ms {
            assert!(ms >= 1 && ms <= 4000, "product: program_watchdog_ms must be 1 to 4000");
        }
        assert!(
            self.answer_to_reset_ms >= 10,
            "product: answer_to_reset_ms must be 10 or more (SYS TEC manual L-1112d_10, 4.5)"
        );
        assert!(
            self.answer_to_reset_ms <= 1000,
            "product: answer_to_reset_ms must be 1000 or less: until its reset the device is silent"
        );
        assert!(
            !self.renewal || LAYOUT.staging.is_some(),
            "product: renewal needs a layout with staging, where a new bootloader waits"
        );
        assert!(
            !self.renewal || self.watchdog_ms.is_some(),
            "product: renewal needs watchdog_ms: it ends the trial of a bootloader that hangs"
        );
        assert!(self.renewal_s >= 1 && self.renewal_s <= 3600, "product: renewal_s must be 1 to 3600");
        assert!(
            self.profile.download.locked != self.profile.password.is_empty(),
            "product: a profile that locks 1F50h needs a password, and only such a profile has one"
        );
        assert!(
            LAYOUT.home.is_some() || !self.lss || !self.profile.download.locked,
            "product: lss needs the split map in a profile with a password: the compact one has no room for \
             both; Product::of(profile) has what fits"
        );
        assert!(
            LAYOUT.home.is_some() || !self.intel_hex || sends_hex(&self.profile),
            "product: intel_hex needs the split map, or ESAcademy's profile: the compact one has no room for it"
        );
        assert!(
            self.auto_bit_rate || BIT_RATE != 0,
            "product: the board leaves the bit rate to be found out (0), and auto_bit_rate is off"
        );
        self
    }

    /// A device without stored values has the node-ID and the bit rate of the profile or the board: they must be
    /// among those that the product takes.
    const fn check_board_node(&self) {
        let (node_id, bit_rate) = match self.profile.default_node {
            Some((id, bit_rate)) => (id.get(), Some(bit_rate)),
            None => (NODE_ID, BitRate::from_bits_per_second(BIT_RATE)),
        };
        let index = match bit_rate {
            // For the first one the product needs `auto_bit_rate`; the second one is the board's mistake.
            Some(BitRate::Auto) | None => *self.bit_rates.start(),
            Some(bit_rate) => bit_rate as u8,
        };
        assert!(
            index >= *self.bit_rates.start() && index <= *self.bit_rates.end(),
            "product: bit_rates is without the bit rate of a new device (bit_rate of the board, or that of the \
             profile): add its index, or change the board's"
        );
        if matches!(self.node_source, NodeSource::Function(_)) {
            return;
        }
        assert!(
            node_id == NO_NODE_ID || node_id >= *self.node_ids.start() && node_id <= *self.node_ids.end(),
            "product: node_ids is without the node-ID of a new device (node_id of the board, or that of the \
             profile): add it, or set the board's to one of them, or to 255 for none"
        );
        assert!(
            node_id != NO_NODE_ID || self.lss || self.profile.node_id.is_some(),
            "product: without lss a new device never gets a node-ID (node_id of the board is 255): set lss, or the \
             board's node_id"
        );
    }

    /// The policy for downloads to a device of this identity: the profile's rules with the product's
    /// choices.
    pub const fn download(&self, device: &Nameplate, renewal: &'static Renewal) -> Policy {
        Policy {
            identity: if self.identity_check { Some((device.vendor_id, device.product_code)) } else { None },
            check: self.check,
            allowed: self.programming_allowed,
            erase: match self.erase {
                Some(erase) => erase,
                None => self.profile.download.erase,
            },
            crc: self.crc,
            crc_step: self.crc_step,
            seal: if SEALED { self.seal(device) } else { SealPolicy::NONE },
            read_back: self.reads_back(),
            renewal: if self.renewal { Some(renewal) } else { None },
            ..self.profile.download
        }
    }

    /// The objects beyond those of every product.
    pub const fn extras(&self) -> Extras {
        Extras {
            sealed: SEALED,
            second_server: self.second_server,
            resume: self.resume,
            program_date: self.program_date,
            read_back: self.reads_back(),
            bootloader: self.bootloader_number(),
            rom_loader: self.rom_loader,
            ..self.profile.extras
        }
    }

    /// The program number of the bootloader itself.
    pub const fn bootloader_number(&self) -> Option<u8> {
        if self.renewal {
            Some(renewal::number(LAYOUT.programs.len() as u8, self.profile.download.data))
        } else {
            None
        }
    }

    const fn reads_back(&self) -> bool {
        self.read_back && self.profile.extras.read_back
    }

    /// The values with which a device of this identity checks sealed images.
    const fn seal(&self, device: &Nameplate) -> SealPolicy {
        SealPolicy {
            vendor_id: device.vendor_id,
            product_code: device.product_code,
            revision: device.revision,
            data: self.profile.download.data,
            unique_id: bsp::unique_id,
            cycles: bsp::cycles,
            counter: self.security_counter,
            counter_with_confirmation: self.counter_with_confirmation,
        }
    }

    /// The policy for the decision after a reset.
    pub const fn decision(&self) -> decision::Policy {
        decision::Policy {
            autostart: self.autostart,
            programs: &PROGRAMS,
            max_crash_resets: self.max_crash_resets,
            node_ids: *self.node_ids.start()..=*self.node_ids.end(),
            rescue_window_ms: self.rescue_window_ms,
            rescue_window_confirmed_ms: self.rescue_window_confirmed_ms,
            start_allowed: self.start_allowed,
            two_resets: self.two_resets,
            renewal: self.renewal,
            sealed: SEALED,
            layout: LAYOUT,
            crc: self.crc,
        }
    }
}

/// Whether the tools of the dialect may use SDO block transfer: Paulus' manual says "no", and ESAcademy's paper names
/// none.
const fn has_block_transfer(profile: &Profile) -> bool {
    !matches!(profile.unknown_request, AbortCode::GENERAL) && !sends_hex(profile)
}

/// Whether the dialect is ESAcademy's, whose tools send Intel HEX.
const fn sends_hex(profile: &Profile) -> bool {
    matches!(profile.extras.password, PasswordObject::EnableFlash)
}

/// Whether this base and a node-ID of the product make a COB-ID that the predefined connection set has for another
/// service, or that no configurable object may have (CiA 301 clauses 7.3.3 and 7.3.5, table of restricted CAN-IDs;
/// CiA 305 for LSS). `own` is the base of SDO there. PDOs do not count: their COB-IDs can be configured.
const fn is_taken(base: u16, own: u16, product: &Product) -> bool {
    const fn is_free(base: u16, node_id: u8) -> bool {
        matches!(base + node_id as u16, 0x181..=0x57F | 0x680..=0x6DF)
    }
    let mut free = match product.profile.node_id {
        Some(id) => is_free(base, id.get()),
        None => true,
    };
    let mut node_id = *product.node_ids.start();
    while node_id <= *product.node_ids.end() {
        free &= is_free(base, node_id);
        node_id += 1;
    }
    base != own && !free
}

/// The source of the device's identity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IdentitySource {
    /// The board file, for all devices; the serial number is a fold of the chip's unique identifier.
    Board,
    /// The nameplate that the production line of an OEM has written into the one-time programmable (OTP)
    /// bytes of the chip ([`shared_abi::nameplate`]). A device without a good one has the identity of `Board`.
    Otp,
}

/// The source of node-ID and bit rate.
#[derive(Clone, Copy, Debug)]
pub enum NodeSource {
    /// The parameters, where layer setting services (LSS) stored them; until then the board's or
    /// the profile's values.
    Stored,
    /// The board's or the profile's values, whatever is stored.
    Constant,
    /// A function, for instance one that reads switches. It returns the node-ID, and the bit rate
    /// as the index of CiA 305 table 1. An invalid node-ID stands for none (LSS may set one). An
    /// invalid bit rate, or one that this device does not support, stands for the board's. The
    /// function runs in the boot stage, before any peripheral is set up, and must leave the
    /// peripherals that it uses as after a reset ([`bsp::inputs`] does).
    Function(fn() -> (u8, u8)),
}

/// The numbers of the programs, without the profile's data.
pub const PROGRAMS: [u8; LAYOUT.programs.len() - HAS_DATA as usize] = {
    let mut numbers = [0; LAYOUT.programs.len() - HAS_DATA as usize];
    let (mut number, mut count) = (1, 0);
    while count < numbers.len() {
        if !matches!(PRODUCT.profile.download.data, Some(data) if data == number) {
            numbers[count] = number;
            count += 1;
        }
        number += 1;
    }
    numbers
};
/// Whether the profile's data are in the layout.
const HAS_DATA: bool =
    matches!(PRODUCT.profile.download.data, Some(data) if data as usize <= LAYOUT.programs.len());

/// 2007h/10.
pub const PROGRAM_START: ProgramStart = ProgramStart {
    watchdog_ms: match PRODUCT.program_watchdog_ms {
        Some(ms) => ms,
        None => 0,
    },
    by_itself: match PRODUCT.autostart {
        Autostart::InOrder => first_two(&PROGRAMS),
        Autostart::List(list) => first_two(list),
        Autostart::Function(_) => [ProgramStart::DECIDED, 0],
    },
};

const fn first_two(list: &[u8]) -> [u8; 2] {
    match list {
        [] => [0; 2],
        [only] => [*only, 0],
        [first, second, ..] => [*first, *second],
    }
}

/// This product.
pub const PRODUCT: Product = chosen::PRODUCT.checked();

/// This product, for the boot stage.
#[derive(Clone, Copy)]
pub struct Chosen;

impl decision::Product for Chosen {
    fn policy(&self) -> &decision::Policy {
        const { &PRODUCT.decision() }
    }
}

/// The values for a renewal of the bootloader in a device of this identity.
pub const fn renewal(device: &Nameplate) -> Renewal {
    Renewal {
        board: BOARD_IDENTITY,
        features: ABILITIES,
        identity: Some((device.vendor_id, device.product_code)),
        revision: device.revision,
        confirm_within_s: PRODUCT.renewal_s,
    }
}

/// The identity of the board file, with the chip's serial number.
pub const BOARD: Nameplate = Nameplate::new(IDENTITY.vendor_id, IDENTITY.product_code, IDENTITY.revision, 0);

/// Whether a device may have an identity that is not the board's.
pub const HAS_NAMEPLATE: bool = matches!(PRODUCT.identity, IdentitySource::Otp);

/// The nameplate of this device, if the product has one.
pub fn nameplate() -> Option<Nameplate> {
    match PRODUCT.identity {
        IdentitySource::Board => None,
        IdentitySource::Otp => bsp::nameplate(),
    }
}

/// 1018h/4 of this device.
pub fn serial_number(nameplate: Option<&Nameplate>) -> u32 {
    match nameplate {
        Some(&Nameplate { serial_number: number @ 1.., .. }) => number,
        _ => bsp::serial_number(),
    }
}

/// The choices that the resident part decides by and that the RAM image shares.
pub const FACTS: Facts = Facts {
    board: BOARD_IDENTITY,
    size: Facts::SIZE,
    autostart: u16::from_le_bytes(PROGRAM_START.by_itself),
    crc_bits: match PRODUCT.crc {
        CrcKind::Crc32 => 32,
        CrcKind::Crc16 => 16,
    },
    node_ids: *PRODUCT.node_ids.start() as u16 | (*PRODUCT.node_ids.end() as u16) << 8,
    bit_rates: ((2 << *PRODUCT.bit_rates.end()) - (1 << *PRODUCT.bit_rates.start()))
        | ((PRODUCT.auto_bit_rate as u16) << BitRate::Auto as u8),
    abilities: ABILITIES.0 as u16,
    sdo_request_base: PRODUCT.sdo_request_base,
    sdo_response_base: PRODUCT.sdo_response_base,
};

/// Version of the bootloader: major in the upper half, minor in the lower.
pub const VERSION: u32 = 0x0000_0001;

/// The store of this product's parameters. A product with an EEPROM puts its own
/// [`boot_core::store::Parameters`] here.
pub type Parameters = Journal;

/// The parameters of this device.
pub fn parameters(flash: &impl Flash) -> Parameters {
    Journal::open(flash, LAYOUT.parameters)
}

/// Node-ID and bit rate of a device that has none stored.
pub const BOARD_NODE: NodeParameters = NodeParameters {
    id: match NODE_ID {
        NO_NODE_ID => None,
        id => match NodeId::new(id) {
            Some(id) => Some(id),
            None => panic!("board: the node-ID must be 1 to 127, or 255 for none"),
        },
    },
    bit_rate: match BitRate::from_bits_per_second(BIT_RATE) {
        Some(rate) => {
            assert!(supports(rate), "board: the clock of the CAN controller cannot make the bit rate");
            rate
        }
        None => panic!("board: the bit rate must be one of CANopen's, or 0 to find it out"),
    },
};
/// The value for no node-ID (CiA 305).
pub const NO_NODE_ID: u8 = 255;

/// Node-ID and bit rate that are valid from this reset on.
pub fn node_parameters<F: Flash>(
    parameters: &impl boot_core::store::Parameters,
    flash: &F,
) -> NodeParameters {
    let default =
        PRODUCT.profile.default_node.map(|(id, bit_rate)| NodeParameters { id: Some(id), bit_rate });
    let default = default.unwrap_or(BOARD_NODE);
    match PRODUCT.node_source {
        NodeSource::Stored => NodeParameters::load(parameters, flash, default, supports),
        NodeSource::Constant => default,
        NodeSource::Function(read) => {
            let (id, index) = read();
            let bit_rate = BitRate::from_index(index).filter(|rate| supports(*rate));
            NodeParameters { id: NodeId::new(id), bit_rate: bit_rate.unwrap_or(default.bit_rate) }
        }
    }
}

/// Whether the product allows this bit rate and the board's CAN controller can run at it.
pub const fn supports(rate: BitRate) -> bool {
    match rate {
        BitRate::Auto => PRODUCT.auto_bit_rate,
        rate => {
            let index = rate as u8;
            index >= *PRODUCT.bit_rates.start()
                && index <= *PRODUCT.bit_rates.end()
                && TIMINGS[index as usize] != 0
        }
    }
}

/// The warm-start cell of this board.
pub fn warm_start_cell() -> Cell {
    // SAFETY: the layout's warm-start region was checked to be RAM of that size, and the linker
    // keeps every image out of it.
    unsafe { Cell::at(LAYOUT.warm_start.base as *mut _) }
}

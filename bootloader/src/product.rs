//! The choices that a product has. A product makes them in its file, `products/default.rs`; the table of all
//! of them is `choices.rs`.
//!
//! A library of its own: the resident part and the RAM image are both built from it, and the tests on the
//! host read it. If choices contradict each other, the build fails, names them, and says what to write.
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
use boot_core::control::{self, Policy};
use boot_core::decision;
use boot_core::flash::Flash;
use boot_core::policy::SealPolicy;
use boot_core::store::NodeParameters;
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

/// Whether the board has the split map.
pub const SPLIT: bool = LAYOUT.home.is_some();

/// Whether the board's layout has staging, where a new bootloader waits.
pub const STAGING: bool = LAYOUT.staging.is_some();

/// Whether the bootloader itself can be renewed.
pub const RENEWS: bool = PRODUCT.renewal.is_some();

/// The abilities of the resident part, which the RAM image needs.
pub const ABILITIES: Abilities = Abilities::NONE
    .with(Abilities::SEALED, SEALED)
    .with(Abilities::RENEWAL, RENEWS)
    .with(Abilities::ROM_LOADER, PRODUCT.ways_in.rom_loader)
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

/// Makes the struct of the choices, its groups, and their defaults of the table in `choices.rs`.
macro_rules! choices {
    ($(
        $(#[doc = $about:literal])*
        $group:ident: $type:ty = $default:expr => [$($other:expr),*]
        $(, $(#[$meta:meta])* struct $Group:ident {
            $(
                $(#[doc = $text:literal])*
                $field:ident: $field_type:ty = $field_default:expr => [$($field_other:expr),*];
            )*
        })?
    ;)*) => {
        /// The choices of a product.
        #[derive(Clone, Debug)]
        pub struct Product {
            $($(#[doc = $about])* pub $group: $type,)*
        }

        impl Product {
            /// A product with no choice of its own.
            pub const DEFAULT: Self = Self { $($group: $default,)* };
        }

        $($(
            #[doc = concat!("See [`Product::", stringify!($group), "`].")]
            #[derive(Clone, Debug)]
            $(#[$meta])*
            pub struct $Group {
                $($(#[doc = $text])* pub $field: $field_type,)*
            }

            impl $Group {
                /// The defaults of the group.
                pub const DEFAULT: Self = Self { $($field: $field_default,)* };
            }
        )?)*
    };
}

include!("choices.rs");

impl Product {
    /// A product whose only choice is its dialect. On the compact map a dialect has what its manual has:
    /// ESAcademy's has Intel HEX, it and Paulus' have no SDO block transfer; ESAcademy's nodes and lifts have a node-ID
    /// of their own, and no LSS.
    pub const fn of(profile: Profile) -> Self {
        let Self { lss, block_download, download, .. } = Self::DEFAULT;
        Self {
            lss: if SPLIT || !profile.download.locked { lss } else { None },
            block_download: if SPLIT || has_block_transfer(&profile) { block_download } else { None },
            download: Download { intel_hex: SPLIT || sends_hex(&profile), ..download },
            profile,
            ..Self::DEFAULT
        }
    }

    /// Returns the product if its choices are consistent; otherwise it fails the build with the
    /// message of the broken rule.
    pub const fn checked(self) -> Self {
        self.check_autostart();
        self.check_map();
        self.check_node();
        self.check_sdo();
        let Download { crc, crc_step, block_buffer, .. } = self.download;
        assert!(
            !SEALED || matches!(crc, CrcKind::Crc32),
            "product: a sealed image carries a CRC-32: write `crc: CrcKind::Crc32`"
        );
        assert!(
            !(SEALED && self.ways_in.rom_loader),
            "product: ways_in.rom_loader would write any program into a device that takes sealed images: write \
             `rom_loader: false`"
        );
        assert!(crc_step >= 64, "product: download.crc_step must be 64 bytes or more");
        assert!(
            crc_step <= 64 * 1024,
            "product: download.crc_step must be 65536 bytes or less: the watchdog waits for a step"
        );
        assert!(
            block_buffer >= 1024 && block_buffer < LAYOUT.bootloader_ram().size as usize,
            "product: download.block_buffer must be 1024 bytes or more, and fit the RAM"
        );
        if let Some(ms) = self.watchdog.bootloader_ms {
            assert!(ms >= 250 && ms <= 4000, "product: watchdog.bootloader_ms must be 250 to 4000");
        }
        if let Some(ms) = self.watchdog.program_ms {
            assert!(ms >= 1 && ms <= 4000, "product: watchdog.program_ms must be 1 to 4000");
        }
        let ms = self.nmt.answer_to_reset_ms;
        assert!(
            ms >= 10,
            "product: nmt.answer_to_reset_ms must be 10 or more (SYS TEC manual L-1112d_10, 4.5)"
        );
        assert!(
            ms <= 1000,
            "product: nmt.answer_to_reset_ms must be 1000 or less: until its reset the device is silent"
        );
        assert!(
            self.renewal.is_none() || STAGING,
            "product: renewal needs a layout with staging, where a new bootloader waits: write `renewal: None`"
        );
        if let Some(Renewal { confirm_within_s: s, .. }) = self.renewal {
            assert!(
                self.watchdog.bootloader_ms.is_some(),
                "product: renewal needs watchdog.bootloader_ms, which ends the trial of a bootloader that hangs: write \
                 `renewal: None`, or `bootloader_ms: Some(1000)`"
            );
            assert!(s >= 1 && s <= 3600, "product: renewal.confirm_within_s must be 1 to 3600");
        }
        assert!(
            self.profile.download.locked != self.profile.password.is_empty(),
            "product: a profile that locks 1F50h needs a password, and only such a profile has one"
        );
        self
    }

    const fn check_autostart(&self) {
        let Some(start) = self.autostart else { return };
        if let Autostart::List(list) = start.programs {
            assert!(
                !list.is_empty(),
                "product: autostart.programs has no program: write `autostart: None` for a device that waits for START"
            );
            let mut at = 0;
            while at < list.len() {
                assert!(
                    list[at] != 0,
                    "product: autostart.programs counts from 1; BLCOP_APP_START_INDEX = 0 is program 1"
                );
                assert!(
                    list[at] as usize <= LAYOUT.programs.len(),
                    "product: autostart.programs names a program that the layout has not"
                );
                assert!(
                    !matches!(self.profile.download.data, Some(data) if data == list[at]),
                    "product: autostart.programs names the profile's data, which are no program"
                );
                let mut other = 0;
                while other < at {
                    assert!(list[other] != list[at], "product: autostart.programs names a program twice");
                    other += 1;
                }
                at += 1;
            }
        }
        assert!(start.max_crash_resets >= 1, "product: autostart.max_crash_resets must be 1 or more");
        assert!(
            start.max_crash_resets <= 255,
            "product: autostart.max_crash_resets must be 255 or less: each crash is counted in the flash"
        );
        let heartbeat = self.nmt.heartbeat_ms;
        assert!(
            heartbeat == 0
                || start.rescue_window_ms < heartbeat && start.rescue_window_confirmed_ms < heartbeat,
            "product: the rescue windows of autostart must be shorter than nmt.heartbeat_ms"
        );
    }

    /// What the compact map has no room for.
    const fn check_map(&self) {
        if SPLIT {
            return;
        }
        let Download { resume, read_back, program_date, intel_hex, crc, .. } = self.download;
        assert!(
            matches!(crc, CrcKind::Crc32),
            "product: CrcKind::Crc16 needs the split map, the compact one has no room for it: write `crc: \
             CrcKind::Crc32`"
        );
        assert!(
            self.block_download.is_none() || has_block_transfer(&self.profile),
            "product: block_download needs the split map in the profiles PAULUS and ESACADEMY: write `block_download: \
             None`, or `..Product::of(profile)`, which has what fits"
        );
        assert!(
            !(self.sdo.block_upload
                || resume
                || read_back
                || program_date
                || self.node.auto_bit_rate
                || matches!(self.block_download, Some(BlockDownload { second_server: true, .. }))
                || matches!(self.lss, Some(Lss { identify: true, .. }))),
            "product: sdo.block_upload, block_download.second_server, download.resume, download.read_back, \
             download.program_date, node.auto_bit_rate and lss.identify need the split map, the compact one has no \
             room for them: write `false`"
        );
        assert!(
            self.lss.is_none() || !self.profile.download.locked,
            "product: lss needs the split map in a profile with a password, the compact one has no room for both: \
             write `lss: None`, or `..Product::of(profile)`, which has what fits"
        );
        assert!(
            !intel_hex || sends_hex(&self.profile),
            "product: download.intel_hex needs the split map, or ESAcademy's profile, the compact one has no room for \
             it: write `intel_hex: false`"
        );
    }

    const fn check_sdo(&self) {
        let Sdo { request_base: request, response_base: response, receive_queue, .. } = self.sdo;
        assert!(
            request >= 0x80 && request <= 0x780 && response >= 0x80 && response <= 0x780,
            "product: sdo.request_base and sdo.response_base must be 80h to 780h"
        );
        assert!(
            request.abs_diff(response) >= 0x80,
            "product: sdo.request_base and sdo.response_base must be 80h or more apart"
        );
        assert!(
            request.abs_diff(0x700) >= 0x80 && response.abs_diff(0x700) >= 0x80,
            "product: the COB-IDs of SDO must not be those of boot-up and heartbeat (700h)"
        );
        assert!(
            !is_taken(request, 0x600, self),
            "product: sdo.request_base plus one of node.ids is a COB-ID of another service (CiA 301: 000h to 180h, \
             580h to 67Fh, 6E0h to 7FFh): take 600h, or a base from 180h to 500h, or 680h up to node 95"
        );
        assert!(
            !is_taken(response, 0x580, self),
            "product: sdo.response_base plus one of node.ids is a COB-ID of another service (CiA 301: 000h to 180h, \
             580h to 67Fh, 6E0h to 7FFh): take 580h, or a base from 180h to 500h, or 680h up to node 95"
        );
        assert!(receive_queue >= 8, "product: sdo.receive_queue must be 8 or more");
        if let Some(BlockDownload { segments_per_sub_block: segments, .. }) = self.block_download {
            assert!(
                segments >= 1 && segments <= 127,
                "product: block_download.segments_per_sub_block must be 1 to 127"
            );
        }
    }

    /// A device without stored values has the node-ID and the bit rate of the profile or the board: they must be
    /// among those that the product takes.
    const fn check_node(&self) {
        let Node { ids, bit_rates, auto_bit_rate, source } = &self.node;
        assert!(
            *ids.start() >= 1 && *ids.end() <= 127 && *ids.start() <= *ids.end(),
            "product: node.ids must be a range within 1 to 127"
        );
        assert!(
            *bit_rates.end() <= 8 && *bit_rates.start() <= *bit_rates.end(),
            "product: node.bit_rates must be a range within 0 to 8"
        );
        assert!(
            *auto_bit_rate || BIT_RATE != 0,
            "product: the board leaves the bit rate to be found out (0), and node.auto_bit_rate is off: write \
             `auto_bit_rate: true`, or give the board a bit rate"
        );
        let (node_id, bit_rate) = match self.profile.default_node {
            Some((id, bit_rate)) => (id.get(), Some(bit_rate)),
            None => (NODE_ID, BitRate::from_bits_per_second(BIT_RATE)),
        };
        let index = match bit_rate {
            // For the first one the product needs `auto_bit_rate`; the second one is the board's mistake.
            Some(BitRate::Auto) | None => *bit_rates.start(),
            Some(bit_rate) => bit_rate as u8,
        };
        assert!(
            index >= *bit_rates.start() && index <= *bit_rates.end(),
            "product: node.bit_rates is without the bit rate of a new device (bit_rate of the board, or that of the \
             profile): add its index, or change the board's"
        );
        if matches!(source, NodeSource::Function(_)) {
            return;
        }
        assert!(
            node_id == NO_NODE_ID || node_id >= *ids.start() && node_id <= *ids.end(),
            "product: node.ids is without the node-ID of a new device (node_id of the board, or that of the \
             profile): add it, or set the board's to one of them, or to 255 for none"
        );
        assert!(
            node_id != NO_NODE_ID || self.lss.is_some() || self.profile.node_id.is_some(),
            "product: without lss a new device never gets a node-ID (node_id of the board is 255): write `lss: \
             Some(Lss::DEFAULT)`, or set the board's node_id"
        );
    }

    /// What starts by itself.
    const fn start(&self) -> Start {
        match self.autostart {
            Some(start) => start,
            None => Start {
                programs: Autostart::List(&[]),
                rescue_window_ms: 0,
                rescue_window_confirmed_ms: 0,
                ..Start::DEFAULT
            },
        }
    }

    /// Layer setting services; values of no meaning if there are none.
    pub const fn lss_or_default(&self) -> Lss {
        match self.lss {
            Some(lss) => lss,
            None => Lss { crystal_failure: CrystalFailure::RunFromHsi, ..Lss::DEFAULT },
        }
    }

    /// SDO block download; values of no meaning if there is none.
    pub const fn block_download_or_default(&self) -> BlockDownload {
        match self.block_download {
            Some(block_download) => block_download,
            None => BlockDownload::DEFAULT,
        }
    }

    /// The renewal; the default values, with which a RAM image is for any device, if there is none.
    pub const fn renewal_or_default(&self) -> Renewal {
        match self.renewal {
            Some(renewal) => renewal,
            None => Renewal::DEFAULT,
        }
    }

    /// The policy for downloads to a device of this identity: the profile's rules with the product's
    /// choices.
    pub const fn download_policy(&self, device: &Nameplate, renewal: &'static control::Renewal) -> Policy {
        Policy {
            identity: if self.identity.check { Some((device.vendor_id, device.product_code)) } else { None },
            check: self.hooks.check,
            allowed: self.hooks.programming_allowed,
            erase: match self.hooks.erase {
                Some(erase) => erase,
                None => self.profile.download.erase,
            },
            crc: self.download.crc,
            crc_step: self.download.crc_step,
            seal: if SEALED { self.seal(device) } else { SealPolicy::NONE },
            read_back: self.reads_back(),
            renewal: if self.renewal.is_some() { Some(renewal) } else { None },
            ..self.profile.download
        }
    }

    /// The objects beyond those of every product.
    pub const fn extras(&self) -> Extras {
        Extras {
            sealed: SEALED,
            second_server: matches!(self.block_download, Some(BlockDownload { second_server: true, .. })),
            resume: self.download.resume,
            program_date: self.download.program_date,
            read_back: self.reads_back(),
            bootloader: self.bootloader_number(),
            rom_loader: self.ways_in.rom_loader,
            ..self.profile.extras
        }
    }

    /// The program number of the bootloader itself.
    pub const fn bootloader_number(&self) -> Option<u8> {
        if self.renewal.is_some() {
            Some(renewal::number(LAYOUT.programs.len() as u8, self.profile.download.data))
        } else {
            None
        }
    }

    const fn reads_back(&self) -> bool {
        self.download.read_back && self.profile.extras.read_back
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
            counter: self.seal.counter,
            counter_with_confirmation: self.seal.counter_with_confirmation,
        }
    }

    /// The policy for the decision after a reset.
    pub const fn decision(&self) -> decision::Policy {
        let start = self.start();
        decision::Policy {
            autostart: start.programs,
            programs: &PROGRAMS,
            max_crash_resets: start.max_crash_resets,
            pin_resets_are_crashes: start.pin_resets_are_crashes,
            node_ids: *self.node.ids.start()..=*self.node.ids.end(),
            rescue_window_ms: start.rescue_window_ms,
            rescue_window_confirmed_ms: start.rescue_window_confirmed_ms,
            start_allowed: self.hooks.start_allowed,
            two_resets: self.ways_in.two_resets,
            renewal: self.renewal.is_some(),
            sealed: SEALED,
            layout: LAYOUT,
            crc: self.download.crc,
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
    let mut node_id = *product.node.ids.start();
    while node_id <= *product.node.ids.end() {
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
    watchdog_ms: match PRODUCT.watchdog.program_ms {
        Some(ms) => ms,
        None => 0,
    },
    by_itself: match PRODUCT.start().programs {
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
pub const fn renewal(device: &Nameplate) -> control::Renewal {
    control::Renewal {
        board: BOARD_IDENTITY,
        features: ABILITIES,
        identity: Some((device.vendor_id, device.product_code)),
        revision: device.revision,
        confirm_within_s: PRODUCT.renewal_or_default().confirm_within_s,
    }
}

/// The identity of the board file, with the chip's serial number.
pub const BOARD: Nameplate = Nameplate::new(IDENTITY.vendor_id, IDENTITY.product_code, IDENTITY.revision, 0);

/// Whether a device may have an identity that is not the board's.
pub const HAS_NAMEPLATE: bool = matches!(PRODUCT.identity.source, IdentitySource::Otp);

/// The nameplate of this device, if the product has one.
pub fn nameplate() -> Option<Nameplate> {
    match PRODUCT.identity.source {
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
    crc_bits: match PRODUCT.download.crc {
        CrcKind::Crc32 => 32,
        CrcKind::Crc16 => 16,
    },
    node_ids: *PRODUCT.node.ids.start() as u16 | (*PRODUCT.node.ids.end() as u16) << 8,
    bit_rates: ((2 << *PRODUCT.node.bit_rates.end()) - (1 << *PRODUCT.node.bit_rates.start()))
        | ((PRODUCT.node.auto_bit_rate as u16) << BitRate::Auto as u8),
    abilities: ABILITIES.0 as u16,
    sdo_request_base: PRODUCT.sdo.request_base,
    sdo_response_base: PRODUCT.sdo.response_base,
};

/// Version of the bootloader: major in the upper half, minor in the lower.
pub const VERSION: u32 = 0x0000_0001;

/// The store of a product whose file has none of its own (build.rs): the journal in flash.
#[allow(dead_code, reason = "another product has a store of its own")]
mod in_flash {
    use boot_core::flash::Flash;
    use boot_core::store::Journal;
    use bsp::LAYOUT;

    /// The store of this product.
    pub type Parameters = Journal;

    /// The parameters of this device.
    pub fn parameters(flash: &impl Flash) -> Parameters {
        Journal::open(flash, LAYOUT.parameters)
    }
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
    match PRODUCT.node.source {
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
        BitRate::Auto => PRODUCT.node.auto_bit_rate,
        rate => {
            let index = rate as u8;
            index >= *PRODUCT.node.bit_rates.start()
                && index <= *PRODUCT.node.bit_rates.end()
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

//! The choices of a product: the only file that a product changes.
//!
//! Resident part and RAM part are both built from it. Names in brackets are those of the SYS TEC
//! manual (L-1112d_10, chapter 4.6). A choice that contradicts another one fails the build, by
//! name.
#![allow(dead_code, reason = "each of the two programs uses some of it")]

use core::ops::RangeInclusive;

use boot_core::canopen::{BitRate, NodeId};
use boot_core::control::{Erase, Policy, Verdict};
use boot_core::crc::CrcKind;
use boot_core::decision;
use boot_core::flash::Flash;
#[cfg(feature = "sealed")]
use boot_core::policy::SealPolicy;
use boot_core::profile::Profile;
use boot_core::store::{Journal, NodeParameters};
use bsp::line::TIMINGS;
use bsp::{BIT_RATE, IDENTITY, LAYOUT, NODE_ID};
use shared_abi::block_file;
use shared_abi::warm_start::Cell;

#[path = "test_products.rs"]
mod test_products;

/// What a product may choose.
#[derive(Clone, Debug)]
pub struct Product {
    /// The dialect that it speaks where dialects contradict each other (docs/dialects.md).
    pub profile: Profile,
    /// The program that starts by itself after a reset, 1 to the number of programs; `None` for a
    /// device that waits for 1F51h = 1 (`BLCOP_USE_AUTOSTART_APP`, `BLCOP_APP_START_INDEX`).
    pub autostart: Option<u8>,
    /// So many resets in a row by which the application ended without being asked to end in the
    /// bootloader; at least 1.
    pub max_crash_resets: u32,
    /// How long a program that was never confirmed is held back when it would start by itself, in
    /// ms: an SDO request to the node or any layer setting service keeps the device in the
    /// bootloader meanwhile. 0 for no such window.
    pub rescue_window_ms: u16,
    /// The same for a confirmed program.
    pub rescue_window_confirmed_ms: u16,
    /// Node-IDs with which programs may be started (`BLCOP_MIN_NODEID`, `BLCOP_MAX_NODEID`).
    pub node_ids: RangeInclusive<u8>,
    /// Bit rates that the device may be set to, as indices of CiA 305 table 1: 0 for 1 Mbit/s to 8
    /// for 10 kbit/s (`BLCOP_MIN_BAUIDX`, `BLCOP_MAX_BAUIDX`).
    pub bit_rates: RangeInclusive<u8>,
    /// Where node-ID and bit rate come from (`TgtGetNodeId`).
    pub node_source: NodeSource,
    /// Whether a node says by a boot-up message that it is up (`BLCOP_SEND_BOOTUP`).
    pub boot_up_message: bool,
    /// SDO requests come on this COB-ID and the node-ID on top, at most 780h (`BLCOP_BASE_REQUEST`).
    pub sdo_request_base: u16,
    /// SDO answers go to this one and the node-ID on top, at most 780h (`BLCOP_BASE_RESPONSE`).
    pub sdo_response_base: u16,
    /// Whether the device may find out the bit rate by listening, where none is stored or told.
    pub auto_bit_rate: bool,
    /// Whether an emergency follows each boot-up, which tells a master the bootloader from the
    /// application.
    pub boot_up_emergency: bool,
    /// Period of the heartbeat until a master changes it (1017h), in ms; 0 for none.
    pub heartbeat_ms: u16,
    /// Whether it speaks layer setting services (LSS, CiA 305).
    pub lss: bool,
    /// Whether it starts in LSS configuration state, for a bus with one device to configure.
    pub lss_start_in_configuration: bool,
    /// Whether it says by "non-configured slave" that it has no node-ID.
    pub lss_announce: bool,
    /// Whether LSS may store node-ID and bit rate.
    pub lss_store: bool,
    /// Whether objects can be read by SDO block upload.
    pub block_upload: bool,
    /// Whether vendor-ID and product code of a program have to be the device's
    /// (`BLCOP_IDENTITY_CHECK`).
    pub identity_check: bool,
    /// The product's own check of block 0 and of the label in the image (`TgtProcessAppInfoData`).
    pub check: fn(program: u8, control: &block_file::Control) -> Verdict,
    /// Whether programs may be changed now.
    pub programming_allowed: fn() -> bool,
    /// When CLEAR of a program erases (`TgtCheckEraseApp`); `None` for what the profile does.
    pub erase: Option<fn(program: u8) -> Erase>,
    /// Whether a program that is signed may be started now: a function that looks at a port pin, for
    /// instance (`TgtCheckAppSig`). It runs in the boot stage, before any peripheral is set up, and
    /// must leave what it uses as after a reset ([`bsp::inputs`] does).
    pub start_allowed: fn(program: u8) -> bool,
    /// Which CRC blocks and programs carry (`BLCOP_USE_CRC16`).
    pub crc: CrcKind,
    /// Bytes of flash that one step of a CRC covers, at least 64: the longest that work of the same
    /// priority waits (`BLCOP_MAX_CRC_STEP_SIZE`).
    pub crc_step: u32,
    /// Bytes of blocks that may wait for the flash, 1024 to what RAM is left
    /// (`BLCOP_MAX_PROGRAM_BUFFER`). While a sector of 128 KiB is erased, a bus at 1 Mbit/s brings
    /// some 55 KiB.
    pub block_buffer: usize,
    /// How long a task of the bootloader may be missing before the watchdog resets the chip, in ms,
    /// 100 to 4000; `None` for no watchdog (`BLCOP_USE_WATCHDOG`).
    pub watchdog_ms: Option<u16>,
    /// A program has to feed the independent watchdog within this time, in ms, 1 to 4000, from its
    /// first instruction on; `None` for a program that is started without one.
    pub program_watchdog_ms: Option<u16>,
    /// How long the device stays after the answer to its leaving is on the bus, in ms, at least 10:
    /// clients want to see the answer before anything else happens.
    pub answer_to_reset_ms: u32,
    /// The lowest security counter of a sealed image, whatever is stored (feature `sealed`).
    pub security_counter: u32,
    /// Whether the security counter is raised when a program is confirmed, and not when it is
    /// installed (feature `sealed`).
    pub counter_with_confirmation: bool,
}

impl Product {
    /// What a product is that chooses nothing.
    pub const DEFAULT: Self = Self {
        profile: Profile::STANDARD,
        autostart: Some(1),
        max_crash_resets: 3,
        rescue_window_ms: 300,
        rescue_window_confirmed_ms: 0,
        node_ids: 1..=127,
        bit_rates: 0..=8,
        node_source: NodeSource::Stored,
        boot_up_message: true,
        sdo_request_base: 0x600,
        sdo_response_base: 0x580,
        auto_bit_rate: true,
        boot_up_emergency: true,
        heartbeat_ms: 1000,
        lss: true,
        lss_start_in_configuration: false,
        lss_announce: false,
        lss_store: true,
        block_upload: true,
        identity_check: true,
        check: |_, _| Verdict::Standard,
        programming_allowed: || true,
        erase: None,
        start_allowed: |_| true,
        crc: CrcKind::Crc32,
        crc_step: 1024,
        block_buffer: if cfg!(feature = "sealed") { 48 } else { 80 } * 1024,
        watchdog_ms: Some(1000),
        program_watchdog_ms: None,
        answer_to_reset_ms: 20,
        security_counter: 0,
        counter_with_confirmation: false,
    };

    /// Gives the product back if its choices go together; fails the build with the rule's name if
    /// not.
    pub const fn checked(self) -> Self {
        let programs = LAYOUT.programs.len();
        if let Some(number) = self.autostart {
            assert!(
                number >= 1 && number as usize <= programs,
                "product: autostart names a program that the layout has not"
            );
        }
        assert!(
            !cfg!(feature = "sealed") || matches!(self.crc, CrcKind::Crc32),
            "product: a sealed image carries a CRC-32"
        );
        assert!(self.max_crash_resets >= 1, "product: max_crash_resets must be 1 or more");
        let window = if self.rescue_window_ms > self.rescue_window_confirmed_ms {
            self.rescue_window_ms
        } else {
            self.rescue_window_confirmed_ms
        };
        assert!(
            window == 0 || self.autostart.is_some(),
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
        assert!(self.crc_step >= 64, "product: crc_step must be 64 bytes or more");
        assert!(
            self.block_buffer >= 1024 && self.block_buffer < LAYOUT.ram.size as usize,
            "product: block_buffer must be 1024 bytes or more, and fit the RAM"
        );
        if let Some(ms) = self.watchdog_ms {
            assert!(ms >= 100 && ms <= 4000, "product: watchdog_ms must be 100 to 4000");
        }
        if let Some(ms) = self.program_watchdog_ms {
            assert!(ms >= 1 && ms <= 4000, "product: program_watchdog_ms must be 1 to 4000");
        }
        assert!(
            self.answer_to_reset_ms >= 10,
            "product: answer_to_reset_ms must be 10 or more (SYS TEC manual L-1112d_10, 4.5)"
        );
        if let Some(data) = self.profile.download.data {
            assert!(
                match self.autostart {
                    Some(number) => number != data,
                    None => true,
                },
                "product: autostart names the profile's data, which are no program"
            );
        }
        assert!(
            self.profile.download.locked != self.profile.password.is_empty(),
            "product: a profile that locks 1F50h needs a password, and only such a profile has one"
        );
        assert!(
            self.auto_bit_rate || BIT_RATE != 0,
            "product: the board leaves the bit rate to be found out (0), and auto_bit_rate is off"
        );
        self
    }

    /// How programs are downloaded: the profile's rules with the product's choices.
    pub const fn download(&self) -> Policy {
        Policy {
            identity: if self.identity_check {
                Some((IDENTITY.vendor_id, IDENTITY.product_code))
            } else {
                None
            },
            check: self.check,
            allowed: self.programming_allowed,
            erase: match self.erase {
                Some(erase) => erase,
                None => self.profile.download.erase,
            },
            crc: self.crc,
            crc_step: self.crc_step,
            #[cfg(feature = "sealed")]
            seal: SealPolicy {
                vendor_id: IDENTITY.vendor_id,
                product_code: IDENTITY.product_code,
                revision: IDENTITY.revision,
                data: self.profile.download.data,
                unique_id: bsp::unique_id,
                cycles: bsp::cycles,
                counter: self.security_counter,
                counter_with_confirmation: self.counter_with_confirmation,
            },
            ..self.profile.download
        }
    }

    /// What happens after a reset.
    pub const fn decision(&self) -> decision::Policy {
        decision::Policy {
            autostart: self.autostart,
            max_crash_resets: self.max_crash_resets,
            node_ids: *self.node_ids.start()..=*self.node_ids.end(),
            rescue_window_ms: self.rescue_window_ms,
            rescue_window_confirmed_ms: self.rescue_window_confirmed_ms,
            start_allowed: self.start_allowed,
        }
    }
}

/// Where node-ID and bit rate come from.
#[derive(Clone, Copy, Debug)]
pub enum NodeSource {
    /// From the parameters, where layer setting services stored them; the board's, or the profile's,
    /// until then.
    Stored,
    /// The board's, or the profile's, whatever is stored.
    Constant,
    /// From a function that reads switches, for instance: the node-ID, and the bit rate as the index
    /// of CiA 305 table 1. What is no node-ID stands for none (LSS may give one); what is no bit rate
    /// of this device, for the board's. It runs in the boot stage, before any peripheral is set up,
    /// and must leave what it uses as after a reset ([`bsp::inputs`] does).
    Function(fn() -> (u8, u8)),
}

/// This product, or one that the repository builds beside it (`test_products.rs`).
pub const PRODUCT: Product = test_products::or_this(PRODUCT_OF_THIS_FILE).checked();

/// **What a product changes**: name the fields that differ from the default.
const PRODUCT_OF_THIS_FILE: Product = Product { ..Product::DEFAULT };

/// Version of the bootloader: major in the upper half, minor in the lower.
pub const VERSION: u32 = 0x0000_0001;

/// Where this product keeps its parameters. One with an EEPROM puts its own
/// [`boot_core::store::Parameters`] here.
pub type Parameters = Journal;

/// The parameters of this device.
pub fn parameters(flash: &impl Flash) -> Parameters {
    Journal::open(flash, LAYOUT.parameters)
}

/// Node-ID and bit rate of a device that was never told others.
const BOARD_NODE: NodeParameters = NodeParameters {
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
/// Stands for no node-ID (CiA 305).
pub const NO_NODE_ID: u8 = 255;

/// Node-ID and bit rate in force from this reset on.
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

/// Whether the board's CAN controller can run at this bit rate.
pub const fn supports(rate: BitRate) -> bool {
    match rate {
        BitRate::Auto => PRODUCT.auto_bit_rate,
        rate => {
            let index = rate as u8;
            index >= *PRODUCT.bit_rates.start()
                && index <= *PRODUCT.bit_rates.end()
                && TIMINGS[index as usize].is_some()
        }
    }
}

/// The warm-start cell of this board.
pub fn warm_start_cell() -> Cell {
    // SAFETY: the layout's warm-start region, checked to be RAM of that size that the linker keeps
    // out of every image.
    unsafe { Cell::at(LAYOUT.warm_start.base as *mut _) }
}

//! Everything of the chip except the instruction set: memories, peripherals, clocks, and the
//! address map.

use shared_abi::geometry::{Geometry, Region, SYSTEM_MEMORY};

use crate::bus::node::Pins;
use crate::bxcan::{self, BxCan};
use crate::clock::CycleClock;
use crate::cortex::debug::{Debug, COMPARATORS};
use crate::cortex::exceptions::SYS_TICK;
use crate::cortex::scs::{Effect, Scs};
use crate::costs::CRC_WORD;
use crate::memory::{HostMemory, PAGE};
use crate::options::Options;
use crate::periph::crc::Crc;
use crate::periph::exti::Exti;
use crate::periph::flash::{Flash, Store};
use crate::periph::gpio::Gpio;
use crate::periph::i2c::I2c;
use crate::periph::iwdg::Iwdg;
use crate::periph::otg::{self, Otg};
use crate::periph::pwr::Pwr;
use crate::periph::rcc::{self, Clocks, Rcc, ResetCause};
use crate::periph::syscfg::Syscfg;
use crate::periph::tim::{self, Tim};
use crate::periph::usart::{self, Usart};
use crate::periph::wwdg::Wwdg;
use crate::peripheral::{Peripheral, Unmodelled};
use crate::report::{Access, Report, Reports};
use crate::silicon::Silicon;
use crate::slice::Slice;
use crate::supply::{self, Supervisor, Supply};
use crate::time::{Span, Time};
use crate::variant::{self, Variant};

/// Where flash (or whatever the boot pins choose) shows up for the reset vector.
pub const BOOT_ALIAS: u32 = 0;
/// The pages of the system memory, and behind it of the unique ID and the flash size.
pub const SYSTEM: Region = Region::new(SYSTEM_MEMORY.base, 8 * PAGE);
/// The one-time programmable bytes, 16 blocks of 32 and a lock byte for each (RM0090 section 3.8).
pub const OTP: Region = Region::new(0x1FFF_7800, OTP_BLOCKS * OTP_BLOCK + OTP_BLOCKS);
const OTP_BLOCKS: u32 = 16;
const OTP_BLOCK: u32 = 32;
const UNIQUE_ID: u32 = 0x1FFF_7A10;
const FLASH_SIZE: u32 = 0x1FFF_7A22;
/// Page of the option bytes.
pub const OPTION_PAGE: Region = Region::new(0x1FFF_C000, PAGE);
/// AHB1 and APB peripherals.
pub const PERIPHERALS: Region = Region::new(0x4000_0000, 0x0008_0000);
/// AHB2: USB OTG FS, DCMI, crypto, RNG.
pub const PERIPHERALS_AHB2: Region = Region::new(0x5000_0000, 0x0006_1000);
/// Private peripheral bus: DWT, FPB, system control space, DBGMCU.
pub const PRIVATE: Region = Region::new(0xE000_0000, 0x0010_0000);
const ITM: u32 = 0xE000_0000;
const DWT: u32 = 0xE000_1000;
const FPB: u32 = 0xE000_2000;
const SCS: u32 = 0xE000_E000;
const DBGMCU: u32 = 0xE004_2000;

/// Where loads from hidden sectors of the flash go (PCROP); an address of external memory, which no chip here has.
pub const HIDDEN: Region = Region::new(0x9000_0000, 0x0020_0000);
/// Where the pages are whose words the FPB replaces, one for each comparator; another such address.
pub const PATCHED: Region = Region::new(0x9100_0000, COMPARATORS as u32 * PAGE);
/// What a bank of the flash has, on a chip whose banks can be swapped.
const BANK: u32 = 0x0010_0000;

/// Bit-band alias of the first MiB of SRAM space (PM0214 section 2.2.5); as much as there is SRAM
/// is mapped.
pub const SRAM_ALIAS: u32 = 0x2200_0000;
/// Bit-band alias of the first MiB of peripheral space.
pub const PERIPHERAL_ALIAS: Region = Region::new(0x4200_0000, 0x0200_0000);

/// A modelled block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Block {
    Crc,
    Rcc,
    Flash,
    Gpio(usize),
    Iwdg,
    Wwdg,
    Pwr,
    Syscfg,
    Exti,
    Can1,
    Can2,
    Usart(usize),
    Tim(usize),
    I2c(usize),
    Otg,
}

/// The block that answers at an address, with the offset in its registers.
enum Place {
    Block { block: Block, offset: u32, enable: ClockEnable },
    Scs(u32),
    Dwt(u32),
    Fpb(u32),
    Dbgmcu(u32),
    Itm,
    Nobody,
}

/// Where RCC enables the clock of a block: register offset and bit; `None` for a block that is
/// always clocked.
type ClockEnable = Option<(u32, u32)>;

/// Start, block, and its clock.
const BLOCKS: [(u32, Block, ClockEnable); 45] = [
    (0x4000_0000, Block::Tim(0), Some((rcc::APB1ENR, 0))),
    (0x4000_0400, Block::Tim(1), Some((rcc::APB1ENR, 1))),
    (0x4000_0800, Block::Tim(2), Some((rcc::APB1ENR, 2))),
    (0x4000_0C00, Block::Tim(3), Some((rcc::APB1ENR, 3))),
    (0x4000_1000, Block::Tim(4), Some((rcc::APB1ENR, 4))),
    (0x4000_1400, Block::Tim(5), Some((rcc::APB1ENR, 5))),
    (0x4000_1800, Block::Tim(9), Some((rcc::APB1ENR, 6))),
    (0x4000_1C00, Block::Tim(10), Some((rcc::APB1ENR, 7))),
    (0x4000_2000, Block::Tim(11), Some((rcc::APB1ENR, 8))),
    (0x4000_2C00, Block::Wwdg, Some((rcc::APB1ENR, 11))),
    (0x4000_3000, Block::Iwdg, None),
    (0x4000_4400, Block::Usart(1), Some((rcc::APB1ENR, 17))),
    (0x4000_4800, Block::Usart(2), Some((rcc::APB1ENR, 18))),
    (0x4000_4C00, Block::Usart(3), Some((rcc::APB1ENR, 19))),
    (0x4000_5000, Block::Usart(4), Some((rcc::APB1ENR, 20))),
    (0x4000_5400, Block::I2c(0), Some((rcc::APB1ENR, 21))),
    (0x4000_5800, Block::I2c(1), Some((rcc::APB1ENR, 22))),
    (0x4000_5C00, Block::I2c(2), Some((rcc::APB1ENR, 23))),
    (0x4000_6400, Block::Can1, Some((rcc::APB1ENR, 25))),
    (0x4000_6800, Block::Can2, Some((rcc::APB1ENR, 26))),
    (0x4000_7000, Block::Pwr, Some((rcc::APB1ENR, 28))),
    (0x4001_0000, Block::Tim(12), Some((rcc::APB2ENR, 0))),
    (0x4001_0400, Block::Tim(13), Some((rcc::APB2ENR, 1))),
    (0x4001_1000, Block::Usart(0), Some((rcc::APB2ENR, 4))),
    (0x4001_1400, Block::Usart(5), Some((rcc::APB2ENR, 5))),
    (0x4001_3800, Block::Syscfg, Some((rcc::APB2ENR, 14))),
    (0x4001_3C00, Block::Exti, None),
    (0x4001_4000, Block::Tim(6), Some((rcc::APB2ENR, 16))),
    (0x4001_4400, Block::Tim(7), Some((rcc::APB2ENR, 17))),
    (0x4001_4800, Block::Tim(8), Some((rcc::APB2ENR, 18))),
    (0x4002_0000, Block::Gpio(0), Some((rcc::AHB1ENR, 0))),
    (0x4002_0400, Block::Gpio(1), Some((rcc::AHB1ENR, 1))),
    (0x4002_0800, Block::Gpio(2), Some((rcc::AHB1ENR, 2))),
    (0x4002_0C00, Block::Gpio(3), Some((rcc::AHB1ENR, 3))),
    (0x4002_1000, Block::Gpio(4), Some((rcc::AHB1ENR, 4))),
    (0x4002_1400, Block::Gpio(5), Some((rcc::AHB1ENR, 5))),
    (0x4002_1800, Block::Gpio(6), Some((rcc::AHB1ENR, 6))),
    (0x4002_1C00, Block::Gpio(7), Some((rcc::AHB1ENR, 7))),
    (0x4002_2000, Block::Gpio(8), Some((rcc::AHB1ENR, 8))),
    (0x4002_2400, Block::Gpio(9), Some((rcc::AHB1ENR, 9))),
    (0x4002_2800, Block::Gpio(10), Some((rcc::AHB1ENR, 10))),
    (0x4002_3000, Block::Crc, Some((rcc::AHB1ENR, 12))),
    (0x4002_3800, Block::Rcc, None),
    (0x4002_3C00, Block::Flash, None),
    (0x5000_0000, Block::Otg, Some((rcc::AHB2ENR, 7))),
];

impl Block {
    /// Bytes of its registers.
    fn size(self) -> u32 {
        match self {
            Self::Otg => otg::SIZE,
            _ => 0x400,
        }
    }
}

const RCC_CFGR: u32 = 0x4002_3808;
const SYSCFG_MEMRMP: u32 = 0x4001_3800;

/// Names of blocks that are not modelled, for reports (RM0090 table 1).
const UNMODELLED: [(u32, &str); 18] = [
    (0x4000_2800, "RTC"),
    (0x4000_3400, "I2S2ext"),
    (0x4000_3800, "SPI2"),
    (0x4000_3C00, "SPI3"),
    (0x4000_4000, "I2S3ext"),
    (0x4000_7400, "DAC"),
    (0x4001_2000, "ADC"),
    (0x4001_2C00, "SDIO"),
    (0x4001_3000, "SPI1"),
    (0x4002_4000, "the backup SRAM"),
    (0x4002_6000, "DMA1"),
    (0x4002_6400, "DMA2"),
    (0x4002_8000, "Ethernet"),
    (0x4004_0000, "USB OTG HS"),
    (0x5000_1000, "a FIFO of USB OTG FS"),
    (0x5005_0000, "DCMI"),
    (0x5006_0000, "CRYP/HASH"),
    (0x5006_0800, "RNG"),
];

/// The counters of the machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Counters {
    /// Instructions executed since the machine was made.
    pub instructions: u64,
    /// CPU cycles since the last power-on, sleep and stalls included.
    pub cycles: u64,
    /// Exceptions taken, by exception number (16 is interrupt line 0).
    pub exceptions: Vec<u64>,
    /// Resets since the last power-on, the power-on itself not counted.
    pub resets: u64,
    /// Sectors erased.
    pub sectors_erased: u64,
    /// Units of flash programmed.
    pub units_programmed: u64,
    /// Flash operations refused with an error flag.
    pub flash_refused: u64,
    /// Flash operations with a supply too low for their width: what they leave does not last.
    pub flash_weak: u64,
    /// How often the CPU was stalled because it wanted the flash while that was busy.
    pub flash_stalls: u64,
    /// How long it was stalled for that, altogether.
    pub flash_stall_time: Span,
    /// The longest time between two feeds of the independent watchdog since the machine was made.
    pub longest_between_feeds: Span,
}

/// The chip around the CPU.
pub struct Chip {
    /// What the chip has.
    pub geometry: &'static Geometry,
    variant: &'static Variant,
    silicon: Silicon,
    /// VDD.
    supply: Supply,
    supervisor: Supervisor,
    /// VDD in mV, as the blocks know it.
    vdd: u32,
    /// Whether code costs what the manuals say.
    pub costs: bool,
    /// From cycles to time.
    pub clock: CycleClock,
    /// Core registers and exceptions.
    pub scs: Scs,
    /// Flash interface and array.
    pub flash: Flash,
    /// Clocks and reset flags.
    pub rcc: Rcc,
    /// The watchdog.
    pub iwdg: Iwdg,
    wwdg: Wwdg,
    /// The ports.
    pub gpio: Vec<Gpio>,
    /// CAN1 and CAN2.
    pub can: [BxCan; 2],
    /// The USARTs, as in [`usart::INSTANCES`].
    pub usarts: [Usart; 6],
    /// The timers, as in [`tim::INSTANCES`].
    tims: [Tim; 14],
    i2c: [I2c; 3],
    otg: Otg,
    pwr: Pwr,
    crc: Crc,
    syscfg: Syscfg,
    exti: Exti,
    dbgmcu: [u32; 3],
    /// SRAM1, SRAM2 and (where there is one) SRAM3, contiguous.
    pub sram: HostMemory,
    /// Core-coupled memory.
    pub ccm: HostMemory,
    /// The pages with system memory, one-time programmable bytes, unique ID and flash size. ST's loader is not there: the system memory is
    /// empty, unless a test puts a program there.
    pub system: HostMemory,
    /// The page with the option bytes.
    pub options: HostMemory,
    /// Pages with words that the FPB replaces.
    pub patched: HostMemory,
    /// The reports of accesses that went wrong.
    pub reports: Reports,
    /// The counters.
    pub counters: Counters,
    /// What the chip and the CPU loop have to say to each other.
    pub slice: Slice,
    clocks: Clocks,
    /// The crystal of the board, in Hz; 0 for none.
    hse_hz: u32,
    /// The core sleeps, and some blocks that it uses have no clock meanwhile.
    is_halved: bool,
    lines: Vec<u16>,
}

impl Chip {
    /// The chip without power.
    #[must_use]
    pub fn new(geometry: &'static Geometry, options: &Options) -> Self {
        let mut system = HostMemory::new(SYSTEM.size, 0xFF);
        let place = |memory: &mut HostMemory, address: u32, bytes: &[u8]| {
            let at = (address - SYSTEM.base) as usize;
            memory.bytes_mut()[at..at + bytes.len()].copy_from_slice(bytes);
        };
        for (i, word) in (0..).zip(options.unique_id) {
            place(&mut system, UNIQUE_ID + 4 * i, &word.to_le_bytes());
        }
        let kib = u16::try_from(geometry.flash.size / 1024).unwrap_or(u16::MAX);
        place(&mut system, FLASH_SIZE, &kib.to_le_bytes());
        let variant = variant::of(geometry);
        let silicon = options.silicon;
        let rcc = Rcc::new(variant, options.hse_hz, silicon);
        Self {
            geometry,
            variant,
            silicon,
            supply: Supply::new(options.vdd_mv),
            supervisor: Supervisor::default(),
            vdd: supply::NOMINAL,
            costs: options.costs,
            clock: CycleClock::new(Time(0), silicon.hsi_hz),
            scs: Scs::new(geometry.interrupts, silicon.hsi_hz.into(), silicon.systick_value),
            flash: Flash::new(geometry, options.flash_times, silicon),
            clocks: rcc.clocks(),
            rcc,
            iwdg: Iwdg::new(silicon),
            wwdg: Wwdg::default(),
            gpio: ('A'..='K').take(geometry.ports.into()).map(Gpio::new).collect(),
            can: [BxCan::new().on(silicon), BxCan::slave().on(silicon)],
            usarts: usart::INSTANCES.each_ref().map(Usart::new),
            tims: tim::INSTANCES.each_ref().map(Tim::new),
            i2c: ["I2C1", "I2C2", "I2C3"].map(I2c::new),
            otg: Otg::default(),
            pwr: Pwr::new(variant),
            crc: Crc::default(),
            syscfg: Syscfg::default(),
            exti: Exti::default(),
            dbgmcu: [0; 3],
            sram: HostMemory::new(geometry.sram.size, 0),
            ccm: HostMemory::new(geometry.ccm.size.max(PAGE), 0),
            system,
            options: HostMemory::new(OPTION_PAGE.size, 0xFF),
            patched: HostMemory::new(PATCHED.size, 0),
            reports: Reports::default(),
            counters: Counters {
                instructions: 0,
                cycles: 0,
                exceptions: vec![0; usize::from(16 + geometry.interrupts)],
                resets: 0,
                sectors_erased: 0,
                units_programmed: 0,
                flash_refused: 0,
                flash_weak: 0,
                flash_stalls: 0,
                flash_stall_time: Span(0),
                longest_between_feeds: Span(0),
            },
            slice: Slice::default(),
            hse_hz: options.hse_hz,
            is_halved: false,
            lines: Vec::new(),
        }
    }

    /// Programs one-time programmable bytes as a debug probe does: a bit only goes from 1 to 0, and one of a
    /// locked block stays. Returns whether all of these blocks could be programmed. `address` and the bytes
    /// are in [`OTP`].
    pub fn program_otp(&mut self, address: u32, bytes: &[u8]) -> bool {
        let otp = &mut self.system.bytes_mut()[(OTP.base - SYSTEM.base) as usize..][..OTP.size as usize];
        let (data, locks) = otp.split_at_mut((OTP_BLOCKS * OTP_BLOCK) as usize);
        let mut is_open = true;
        for (offset, byte) in ((address - OTP.base) as usize..).zip(bytes) {
            match data.get_mut(offset) {
                Some(_) if locks[offset / OTP_BLOCK as usize] == 0 => is_open = false,
                Some(cell) => *cell &= byte,
                None => locks[offset - data.len()] &= byte,
            }
        }
        is_open
    }

    /// The memory at an address from 0 on, and its address there: flash, or the system memory. The same for an
    /// address of the flash whose banks are swapped.
    #[must_use]
    pub fn behind_alias(&self, address: u32) -> Option<u32> {
        let memory = if self.syscfg.maps_system_memory() { SYSTEM_MEMORY } else { self.geometry.flash };
        let swap = |address: u32| match self.swaps_banks() && self.geometry.flash.contains(address, 1) {
            true => address ^ BANK,
            false => address,
        };
        if address < memory.size {
            return Some(swap(memory.base + address));
        }
        self.swaps_banks().then(|| swap(address))
    }

    /// Whether the second bank of the flash is in the place of the first.
    #[must_use]
    pub fn swaps_banks(&self) -> bool {
        self.geometry.second_bank.is_some() && self.syscfg.swaps_banks()
    }

    /// What ST's loader does after a reset with BFB2 (AN2606, dual bank boot): it starts the bank whose first word
    /// is an address in SRAM, the second bank first, which it maps to the start of the flash. Returns the address
    /// of the vector table; `None` if a program is in the system memory here, or if neither bank has one.
    pub fn dual_bank_boot(&mut self) -> Option<u32> {
        let is_empty = self.system.bytes()[..4] == [0xFF; 4];
        if !self.flash.boots_from_system_memory() || !is_empty {
            return None;
        }
        let Region { base, size } = self.geometry.sram;
        let is_program = |offset: u32| {
            let at = offset as usize;
            let sp = u32::from_le_bytes(self.flash.array.bytes()[at..at + 4].try_into().expect("a word"));
            (base..=base + size).contains(&sp)
        };
        let bank = [BANK, 0].into_iter().find(|bank| is_program(*bank))?;
        self.syscfg.swap_banks(bank != 0);
        Some(self.geometry.flash.base)
    }

    /// The virtual time.
    #[must_use]
    pub fn now(&self) -> Time {
        self.clock.now()
    }

    /// The cycle of the access that the program makes to a counter of the core.
    fn cycle_of_access(&self) -> u64 {
        self.clock.cycles.saturating_sub(self.slice.ahead)
    }

    /// A system reset of everything but the CPU: RAM stays, the flags in RCC_CSR gather.
    pub fn reset(&mut self, cause: ResetCause) {
        self.rcc.note_reset(cause);
        self.iwdg.reset();
        match cause {
            ResetCause::Standby => self.pwr.leave_standby(),
            _ => self.pwr.reset(),
        }
        self.reset_core_domain(cause);
        if self.flash.hardware_watchdog() {
            let now = self.now();
            // The key that starts the watchdog is always accepted.
            let _ = self.iwdg.write(0x00, 0xCCCC, now);
        }
        self.follow_watchdog();
    }

    /// Enters Standby: the supply of the core domain goes off; a watchdog that runs goes on.
    pub fn enter_standby(&mut self) {
        self.reset_core_domain(ResetCause::Standby);
        self.follow_watchdog();
        if self.pwr.enter_standby() {
            self.wake_up();
        }
    }

    /// Whether the option bits have a reset in place of the deep sleep that a WFI enters (section 7.1.1,
    /// low-power management reset).
    #[must_use]
    pub fn deep_sleep_is_reset(&self, is_standby: bool) -> bool {
        self.flash.low_power_is_reset(is_standby)
    }

    /// The crystal of the board has this frequency from now on, 0 when it stops.
    pub fn set_crystal(&mut self, hz: u32) {
        self.hse_hz = hz;
        self.rcc.set_crystal(hz);
        self.slice.leave = true;
    }

    /// Leaves Standby.
    pub fn wake_up(&mut self) {
        self.pwr.wake_up();
        self.slice.reset_request = Some(ResetCause::Standby);
    }

    /// VDD in mV.
    #[must_use]
    pub fn vdd(&self) -> u32 {
        self.supply.at(self.now())
    }

    /// Lets VDD go to `mv` within a time, from `now` on.
    pub fn set_supply(&mut self, mv: u32, within: Span, now: Time) {
        self.supply.go_to(mv, within, now);
        self.slice.leave = true;
    }

    /// The supply holds the chip in reset: what is in the core domain is as after a reset, and the watchdog
    /// stands (section 7.1.2).
    pub fn hold_in_reset(&mut self) {
        self.iwdg.reset();
        self.pwr.lose_supply();
        self.reset_core_domain(ResetCause::BrownOut);
        self.follow_watchdog();
    }

    /// The supply is back, for a reset. After a power-down it is a power-on.
    pub fn leave_reset(&mut self, powered_down: bool) {
        if powered_down {
            self.lose_power();
        }
        self.slice.reset_request =
            Some(if powered_down { ResetCause::PowerOn } else { ResetCause::BrownOut });
    }

    /// Only a power-down resets this.
    fn lose_power(&mut self) {
        self.rcc = Rcc::new(self.variant, self.hse_hz, self.silicon);
        self.pwr.lose_supply();
    }

    /// Follows VDD.
    fn follow_supply(&mut self, now: Time) {
        let mv = self.supply.at(now);
        if let Some(change) = self.supervisor.watch(mv, self.flash.brown_out_level(), now) {
            self.slice.supply = Some(change);
            self.slice.leave = true;
        }
        if mv == self.vdd {
            return;
        }
        let limits = |mv| self.geometry.line.limits_at(mv);
        let is_slower = limits(mv).per_wait_state < limits(self.vdd).per_wait_state;
        self.vdd = mv;
        self.pwr.set_supply(mv);
        self.flash.set_supply(mv);
        self.show_pins();
        if is_slower && !self.supervisor.holds() {
            self.check_clocks();
        }
    }

    /// See [`Iwdg::preset`]; the prescaler stays.
    pub fn preset_watchdog(&mut self, reload: u32) {
        let now = self.now();
        self.iwdg.preset(reload, now);
        self.follow_watchdog();
    }

    /// A rising edge at the pin WKUP. Returns whether it is a wake-up.
    pub fn wkup_rises(&mut self) -> bool {
        self.pwr.wkup_rises()
    }

    /// Whether a WFI now enters Standby; `None` if the sleep is not deep.
    #[must_use]
    pub fn deep_sleep_is_standby(&self) -> Option<bool> {
        self.scs.sleeps_deeply().then(|| self.pwr.chooses_standby())
    }

    /// The watchdog forces the LSI on, and the LSI carries its updates out.
    fn follow_watchdog(&mut self) {
        let now = self.now();
        if self.iwdg.is_running() {
            self.rcc.force_lsi(now);
        }
        self.iwdg.follow_lsi(self.rcc.lsi_is_on(), now);
    }

    fn reset_core_domain(&mut self, cause: ResetCause) {
        self.is_halved = false;
        let (crc, syscfg): (&mut dyn Peripheral, _) = (&mut self.crc, &mut self.syscfg);
        for block in [crc, syscfg, &mut self.exti, &mut self.wwdg, &mut self.rcc, &mut self.flash] {
            block.reset();
        }
        for can in &mut self.can {
            can.reset();
        }
        for port in &mut self.gpio {
            port.reset();
        }
        for usart in &mut self.usarts {
            usart.reset();
        }
        for tim in &mut self.tims {
            tim.reset();
        }
        for i2c in &mut self.i2c {
            i2c.reset();
        }
        self.otg.reset();
        if self.flash.boots_from_system_memory() {
            self.syscfg.boot_from_system_memory();
        }
        self.wire_pins();
        let option_bytes = self.flash.option_bytes();
        self.options.bytes_mut()[..option_bytes.len()].copy_from_slice(&option_bytes);
        self.apply_clocks();
        // A power reset, which brown-out and the end of Standby are, too (RM0090 section 7.1.2), resets all of it.
        let debug = match cause {
            ResetCause::PowerOn | ResetCause::BrownOut | ResetCause::Standby => {
                self.dbgmcu = [0; 3];
                Debug::default()
            }
            _ => self.scs.debug.after_reset(),
        };
        self.scs = Scs::new(self.geometry.interrupts, self.clock.hz(), self.silicon.systick_value);
        self.scs.debug = debug;
        self.slice.breakpoints_changed = true;
        self.slice.leave = false;
        self.slice.check_exceptions = false;
        self.slice.reset_request = None;
        self.slice.supply = None;
        self.slice.hold_until = None;
        self.slice.bus_error = None;
        self.take_flash_changes();
    }

    /// Power-on: as a reset, but all state is lost.
    pub fn power_on(&mut self, now: Time) {
        self.clock = CycleClock::new(now, self.silicon.hsi_hz);
        self.lose_power();
        self.supervisor = Supervisor::default();
        self.counters.resets = 0;
        self.slice.attention = false;
        self.reset(ResetCause::PowerOn);
    }

    fn apply_clocks(&mut self) {
        self.clocks = self.rcc.clocks();
        let now = self.now();
        let is_stopped = self.rcc.is_stopped();
        if is_stopped {
            // Until a reset.
            self.slice.hold_until = Some(Time(u64::MAX));
        } else {
            self.clock.set_hz(self.clocks.hclk);
            self.scs.systick.set_clock(self.clocks.hclk.into(), now);
        }
        for (_, block, enable) in BLOCKS {
            let clock_of = |clock: u32| if self.is_clocked(enable) && !is_stopped { clock } else { 0 };
            let (pclk1, pclk2) = (clock_of(self.clocks.pclk1), clock_of(self.clocks.pclk2));
            let (timclk1, timclk2) = (clock_of(self.clocks.timclk1), clock_of(self.clocks.timclk2));
            match block {
                Block::Wwdg => self.wwdg.set_clock(pclk1, now),
                Block::Can1 => self.can[0].set_clock(pclk1),
                Block::Can2 => self.can[1].set_clock(pclk1),
                Block::Usart(index) => {
                    let usart = &mut self.usarts[index];
                    usart.set_clock(if usart.instance().apb2 { pclk2 } else { pclk1 });
                }
                Block::Tim(index) => {
                    let tim = &mut self.tims[index];
                    tim.set_clock(if tim.instance().apb2 { timclk2 } else { timclk1 }, now);
                }
                _ => {}
            }
        }
        self.tell_slave();
    }

    /// Passes a change of CAN1's filters or clock on to CAN2.
    fn tell_slave(&mut self) {
        let clocked = self.is_clocked(Some((rcc::APB1ENR, 25)));
        let [master, slave] = &mut self.can;
        slave.follow(master, clocked);
    }

    /// Finds the pins that the program has assigned to the USARTs and the CAN controllers.
    fn wire_pins(&mut self) {
        let now = self.now();
        let Self { gpio, usarts, can, geometry, .. } = self;
        let function_of =
            |port: char, pin: u8| gpio.get(port as usize - 'A' as usize).and_then(|port| port.alternate(pin));
        let is_given = |&(port, pin, function): &(char, u8, u8)| function_of(port, pin) == Some(function);
        for usart in usarts {
            let usart::Instance { tx, rx, .. } = usart.instance();
            usart.set_wired(tx.iter().any(is_given), rx.iter().any(is_given));
        }
        for can in can {
            let (rx, tx) = bxcan::pins::connected(geometry, can.share(), function_of);
            can.connect(Pins { rx, tx }, now);
        }
    }

    /// The CPU leaves for a CAN controller that needs the bus.
    fn attend_bus(&mut self) {
        if self.can.iter().any(BxCan::wants_attention) {
            self.slice.attention = true;
            self.slice.leave = true;
        }
    }

    /// Reports a clock tree that the chip cannot follow. The model runs on; silicon would read
    /// rubbish or hang.
    fn check_clocks(&mut self) {
        let Clocks { hclk, pclk1, pclk2, .. } = self.clocks;
        let latency = self.flash.latency();
        let limits = self.geometry.line.limits_at(self.vdd);
        let needed = (hclk - 1) / limits.per_wait_state;
        let mut wrong = Vec::new();
        if latency < needed {
            let at = if self.vdd < 2_700 { format!(" at VDD {} mV", self.vdd) } else { String::new() };
            wrong.push(format!(
                "HCLK is {hclk} Hz with {latency} flash wait states: it needs {needed}{at}, to be set before (FLASH_ACR)"
            ));
        }
        if hclk > limits.sysclk_after_reset && !self.pwr.is_at_scale_1() {
            wrong.push(format!("HCLK is {hclk} Hz: that needs the regulator at scale 1 (PWR_CR.VOS)"));
        }
        // Over-drive is not modelled.
        for (name, hz, most) in
            [("HCLK", hclk, limits.sysclk), ("PCLK1", pclk1, limits.apb1), ("PCLK2", pclk2, limits.apb2)]
        {
            if hz > most {
                wrong.push(format!("{name} is {hz} Hz, the chip's limit is {most}"));
            }
        }
        if !wrong.is_empty() {
            self.report(Access::Write, RCC_CFGR, 4, 0, self.slice.block.0, wrong.join("; "));
        }
    }

    /// The clock tree as set up.
    #[must_use]
    pub fn clocks(&self) -> Clocks {
        self.clocks
    }

    /// Processes all events that are due, and derives the interrupts.
    pub fn advance(&mut self) {
        let now = self.now();
        self.follow_supply(now);
        let hclk = self.clocks;
        self.rcc.advance(now);
        if self.rcc.clocks() != hclk {
            self.apply_clocks();
            self.check_clocks();
            self.slice.leave = true;
        }
        self.flash.advance(now);
        self.settle_flash();
        self.iwdg.advance(now);
        self.wwdg.advance(now);
        for can in &mut self.can {
            can.advance(now);
        }
        for usart in &mut self.usarts {
            usart.advance(now);
        }
        for tim in &mut self.tims {
            tim.advance(now);
        }
        if self.iwdg.has_expired() {
            self.slice.reset_request = Some(ResetCause::IndependentWatchdog);
            self.slice.leave = true;
        } else if self.wwdg.has_expired() {
            self.slice.reset_request = Some(ResetCause::WindowWatchdog);
            self.slice.leave = true;
        }
        if self.scs.systick.advance(now) {
            self.scs.exceptions.pend(SYS_TICK);
        }
        self.update_lines();
    }

    fn update_lines(&mut self) {
        let mut lines = std::mem::take(&mut self.lines);
        lines.clear();
        self.flash.interrupts(&mut lines);
        for can in &self.can {
            can.interrupts(&mut lines);
        }
        for usart in &self.usarts {
            usart.interrupts(&mut lines);
        }
        for tim in &self.tims {
            tim.interrupts(&mut lines);
        }
        self.wwdg.interrupts(&mut lines);
        self.exti.interrupts(&mut lines);
        self.scs.exceptions.set_levels(&lines);
        self.lines = lines;
        self.slice.check_exceptions = self.scs.exceptions.any_pending();
    }

    fn take_flash_changes(&mut self) {
        let base = self.geometry.flash.base;
        for (offset, len) in self.flash.take_changed() {
            self.slice.stale.push((base + offset, len));
            self.slice.leave = true;
        }
        self.counters.sectors_erased = self.flash.counters.sectors_erased;
        self.counters.units_programmed = self.flash.counters.units_programmed;
        self.counters.flash_refused = self.flash.counters.refused;
        self.counters.flash_weak = self.flash.counters.weak;
    }

    /// The time of the next event that the CPU does not cause.
    #[must_use]
    pub fn next_event(&self) -> Option<Time> {
        [
            self.flash.next_event(),
            self.iwdg.next_event(),
            self.wwdg.next_event(),
            self.can[0].next_event(),
            self.can[1].next_event(),
            self.rcc.next_event(),
            self.scs.systick.next_event(),
            self.supply.next_change(self.now()),
        ]
        .into_iter()
        .chain(self.usarts.iter().map(Peripheral::next_event))
        .chain(self.tims.iter().map(Peripheral::next_event))
        .flatten()
        .min()
    }

    /// The deadline or the next event, whichever comes first. An event that is due already is not
    /// counted: either it was processed, or the CPU leaves for it.
    #[must_use]
    pub fn next_stop(&self) -> Time {
        self.stop_before(self.next_event())
    }

    fn stop_before(&self, event: Option<Time>) -> Time {
        let now = self.now();
        event.filter(|&event| event > now).map_or(self.slice.deadline, |event| event.min(self.slice.deadline))
    }

    /// Sets the end of the CPU's run to the deadline or the next event, whichever comes first.
    pub fn limit_slice(&mut self) {
        self.end_slice_at(self.next_event());
    }

    fn end_slice_at(&mut self, event: Option<Time>) {
        let until = self.stop_before(event);
        self.slice.end = self.clock.cycle_at(until);
    }

    /// Reports an access that is wrong or not modelled.
    pub fn report(&mut self, access: Access, address: u32, size: u8, value: u32, pc: u32, what: String) {
        let time = self.now();
        self.reports.add(Report { time, address, pc, size, access, value, what, count: 1 });
    }

    // --- accesses by the CPU
    // -----------------------------------------------------------------------------------------

    /// The CPU loads `size` bytes (1, 2 or 4) from a peripheral address.
    pub fn load(&mut self, address: u32, size: u8) -> u32 {
        let result = if PERIPHERAL_ALIAS.contains(address, 1) {
            let (word, bit) = bit_band(PERIPHERALS.base, address - PERIPHERAL_ALIAS.base);
            self.load_word(word).map(|value| value >> bit & 1)
        } else {
            self.load_word(address & !3).map(|word| word >> (8 * (address & 3)) & mask(size))
        };
        result.unwrap_or_else(|unmodelled| {
            self.complain(Access::Read, address, size, 0, unmodelled);
            0
        })
    }

    /// The CPU stores `size` bytes to a peripheral address.
    pub fn store(&mut self, address: u32, size: u8, value: u32) {
        let result = if PERIPHERAL_ALIAS.contains(address, 1) {
            // The bus matrix reads the word, changes the bit, writes the word (PM0214 section
            // 2.2.5).
            let (word, bit) = bit_band(PERIPHERALS.base, address - PERIPHERAL_ALIAS.base);
            self.change_word(word, 1 << bit, (value & 1) << bit)
        } else if size == 4 || address & 3 == 0 && self.takes_halves(address) {
            self.store_word(address, value)
        } else {
            let shift = 8 * (address & 3);
            self.change_word(address & !3, mask(size) << shift, value << shift)
        };
        if let Err(unmodelled) = result {
            self.complain(Access::Write, address, size, value, unmodelled);
        }
        if address & !3 == SYSCFG_MEMRMP {
            // Other memory may be at address 0 from now on.
            self.slice.flush_tlb = true;
            self.slice.leave = true;
        }
        if self.flash.take_bus_error() {
            self.slice.bus_error = Some(address);
        }
        self.after_write();
    }

    /// Whether a register is one of those that a half-word is all of, so that writing it reads
    /// nothing.
    fn takes_halves(&self, address: u32) -> bool {
        matches!(self.place(address), Place::Block { block: Block::Usart(_), .. })
    }

    fn change_word(&mut self, address: u32, mask: u32, value: u32) -> Result<(), Unmodelled> {
        let old = self.load_word(address)?;
        self.store_word(address, old & !mask | value & mask)
    }

    fn complain(&mut self, access: Access, address: u32, size: u8, value: u32, unmodelled: Unmodelled) {
        let Unmodelled(mut what) = unmodelled;
        if PERIPHERAL_ALIAS.contains(address, 1) {
            let (word, bit) = bit_band(PERIPHERALS.base, address - PERIPHERAL_ALIAS.base);
            what.push_str(&format!(" (the alias of bit {bit} of the register at {word:08X}h)"));
        }
        let time = self.now();
        self.slice.unlocated.push(Report { time, address, pc: 0, size, access, value, what, count: 1 });
    }

    /// Word-sized bit-band access to SRAM: (offset of the byte, bit).
    #[must_use]
    pub fn sram_bit(&self, address: u32) -> Option<(usize, u32)> {
        let offset = address.checked_sub(SRAM_ALIAS)?;
        let byte = (offset / 32) as usize;
        (byte < self.sram.size()).then_some((byte, offset / 4 % 8))
    }

    /// The block that answers at a word-aligned peripheral address.
    fn place(&self, address: u32) -> Place {
        let within = |base: u32, size: u32| Some(address.wrapping_sub(base)).filter(|&offset| offset < size);
        let there = |block: Block| !matches!(block, Block::Gpio(port) if port >= self.gpio.len());
        let block =
            BLOCKS.iter().filter(|&&(_, block, _)| there(block)).find_map(|&(base, block, enable)| {
                within(base, block.size()).map(|offset| Place::Block { block, offset, enable })
            });
        block
            .or_else(|| within(SCS, PAGE).map(Place::Scs))
            .or_else(|| within(DWT, PAGE).map(Place::Dwt))
            .or_else(|| within(FPB, PAGE).map(Place::Fpb))
            .or_else(|| within(DBGMCU, 0x10).map(Place::Dbgmcu))
            .or_else(|| within(ITM, PAGE).map(|_| Place::Itm))
            .unwrap_or(Place::Nobody)
    }

    fn block_mut(&mut self, block: Block) -> &mut dyn Peripheral {
        match block {
            Block::Crc => &mut self.crc,
            Block::Rcc => &mut self.rcc,
            Block::Flash => &mut self.flash,
            Block::Gpio(port) => &mut self.gpio[port],
            Block::Iwdg => &mut self.iwdg,
            Block::Wwdg => &mut self.wwdg,
            Block::Pwr => &mut self.pwr,
            Block::Syscfg => &mut self.syscfg,
            Block::Exti => &mut self.exti,
            Block::Can1 => &mut self.can[0],
            Block::Can2 => &mut self.can[1],
            Block::Usart(index) => &mut self.usarts[index],
            Block::Tim(index) => &mut self.tims[index],
            Block::I2c(index) => &mut self.i2c[index],
            Block::Otg => &mut self.otg,
        }
    }

    fn has_clock(&self, enable: ClockEnable) -> bool {
        enable.is_none_or(|(register, bit)| self.rcc.plain(register) & 1 << bit != 0)
    }

    /// The same while the core may be asleep: the low-power enable bits are 20h after the others (sections
    /// 7.3.15 to 7.3.19).
    fn is_clocked(&self, enable: ClockEnable) -> bool {
        let sleeps_on =
            |(register, bit): (u32, u32)| !self.is_halved || self.rcc.plain(register + 0x20) & 1 << bit != 0;
        self.has_clock(enable) && enable.is_none_or(sleeps_on)
    }

    /// The core falls asleep or wakes up: a block whose low-power enable bit is 0 stands still meanwhile.
    /// All blocks that do something by themselves are at APB1 and APB2.
    pub fn core_sleeps(&mut self, sleeps: bool) {
        let stops = |register| self.rcc.plain(register) & !self.rcc.plain(register + 0x20) != 0;
        let is_halved = sleeps && (stops(rcc::APB1ENR) || stops(rcc::APB2ENR));
        if is_halved != self.is_halved {
            self.is_halved = is_halved;
            self.apply_clocks();
        }
    }

    fn unknown(address: u32) -> Unmodelled {
        let block = UNMODELLED.iter().rev().find(|&&(base, _)| address >= base && address - base < 0x1_0000);
        Unmodelled(match block {
            Some(&(base, name)) => {
                format!("{name} is not modelled (offset {:X}h); it reads as 0", address - base)
            }
            None => "no peripheral is known here; it reads as 0".into(),
        })
    }

    fn load_word(&mut self, address: u32) -> Result<u32, Unmodelled> {
        let now = self.now();
        let result = match self.place(address) {
            Place::Block { block, offset, enable } if self.has_clock(enable) => {
                self.block_mut(block).read(offset, now)
            }
            Place::Block { block, .. } => {
                let name = self.block_mut(block).name();
                Err(Unmodelled(format!("{name} has no clock (RCC enables it); it reads as 0")))
            }
            Place::Scs(offset) => {
                let now = self.clock.time_of(self.cycle_of_access());
                if self.scs.systick.advance(now) {
                    self.scs.exceptions.pend(SYS_TICK);
                }
                self.scs.read(offset, now)
            }
            Place::Dwt(offset) => self.scs.read_dwt(offset, self.cycle_of_access()),
            Place::Fpb(offset) => self.scs.debug.read_fpb(offset),
            Place::Dbgmcu(0) => Ok(self.variant.idcode),
            Place::Dbgmcu(offset) => Ok(self.dbgmcu[offset as usize / 4 - 1]),
            // Stimulus ports that nobody listens to are ready.
            Place::Itm => Ok(1),
            Place::Nobody => Err(Self::unknown(address)),
        };
        self.settle_flash();
        result
    }

    /// The word of a register as a load would give it, whether its block has a clock or not; `None`
    /// where nothing is modelled. What a load does to the register is done.
    pub fn register(&mut self, address: u32) -> Option<u32> {
        let now = self.now();
        match self.place(address & !3) {
            Place::Block { block, offset, .. } => self.block_mut(block).read(offset, now).ok(),
            _ => self.load_word(address & !3).ok(),
        }
    }

    fn store_word(&mut self, address: u32, value: u32) -> Result<(), Unmodelled> {
        let now = self.now();
        match self.place(address) {
            Place::Block { block, offset, enable } if self.has_clock(enable) => {
                self.store_block(block, offset, value, now)
            }
            Place::Block { block, .. } => {
                let name = self.block_mut(block).name();
                Err(Unmodelled(format!("{name} has no clock (RCC enables it); the write is lost")))
            }
            Place::Scs(offset) => {
                let now = self.clock.time_of(self.cycle_of_access());
                self.store_scs(offset, value, now)
            }
            Place::Dwt(offset) => self.scs.write_dwt(offset, value, self.cycle_of_access()),
            Place::Fpb(offset) => {
                self.slice.breakpoints_changed = true;
                self.slice.flush_tlb = true;
                self.slice.leave = true;
                self.scs.debug.write_fpb(offset, value)
            }
            Place::Dbgmcu(0) | Place::Itm => Ok(()),
            Place::Dbgmcu(offset) => {
                self.dbgmcu[offset as usize / 4 - 1] = value;
                Ok(())
            }
            Place::Nobody => Err(Self::unknown(address)),
        }
    }

    fn store_block(&mut self, block: Block, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        let resets_before = self.reset_bits();
        if block == Block::Exti && !self.exti.listens() {
            let levels = self.exti_levels();
            self.exti.settle(levels);
        }
        let caches_data = self.flash.caches_data();
        let result = self.block_mut(block).write(offset, value, now);
        match block {
            Block::Rcc => {
                self.reset_blocks(resets_before);
                let changed = self.rcc.clocks() != self.clocks;
                if changed || offset == rcc::APB1ENR || offset == rcc::APB2ENR {
                    self.apply_clocks();
                    self.slice.leave = true;
                }
                if changed {
                    self.check_clocks();
                }
                self.follow_watchdog();
            }
            Block::Iwdg => self.follow_watchdog(),
            // It may have been written outside its window.
            Block::Wwdg => self.slice.leave = true,
            Block::Crc if self.costs => self.clock.cycles += CRC_WORD,
            Block::Flash => {
                self.slice.leave |= self.flash.caches_data() != caches_data;
                self.settle_flash();
            }
            Block::Gpio(_) => {
                self.wire_pins();
                self.attend_bus();
                self.show_pins();
            }
            Block::Syscfg | Block::Pwr => self.show_pins(),
            Block::Can1 | Block::Can2 => {
                if block == Block::Can1 {
                    self.tell_slave();
                }
                self.attend_bus();
            }
            _ => {}
        }
        result
    }

    /// The levels that EXTI lines 0 to 16 follow: pins, and the voltage detector.
    fn exti_levels(&self) -> u32 {
        (0..16).fold(u32::from(self.pwr.supply_is_low()) << 16, |levels, line| {
            let port = self.gpio.get(self.syscfg.port_of(line));
            levels | u32::from(port.is_some_and(|port| port.level(line))) << line
        })
    }

    /// Updates the levels at the EXTI lines, which may have changed.
    pub fn show_pins(&mut self) {
        if self.exti.listens() {
            let levels = self.exti_levels();
            self.exti.show(levels);
        }
    }

    /// Call it after anything that may have started, ended or waited for a flash operation.
    fn settle_flash(&mut self) {
        if let Some(until) = self.flash.take_wait() {
            self.slice.hold_until = Some(until);
            self.slice.leave = true;
        }
        let busy = self.flash.busy_until().is_some();
        if busy && !self.slice.guarded {
            self.slice.flush_tlb = true;
            self.slice.leave = true;
        }
        self.slice.guarded = busy;
        if self.flash.power_has_failed() {
            self.slice.leave = true;
        }
        self.take_flash_changes();
    }

    fn store_scs(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        if self.scs.systick.advance(now) {
            self.scs.exceptions.pend(SYS_TICK);
        }
        match self.scs.write(offset, value, now)? {
            Effect::None => {}
            Effect::FpuAccess | Effect::Stepping | Effect::Traps => self.slice.leave = true,
            Effect::SystemReset => {
                self.slice.reset_request = Some(ResetCause::Software);
                self.slice.leave = true;
            }
        }
        Ok(())
    }

    /// A write may have raised an interrupt line, or have started or ended something. An event that
    /// has come due within the block that writes is not processed yet: the CPU leaves for it.
    fn after_write(&mut self) {
        self.update_lines();
        let now = self.now();
        let next = self.next_event();
        self.slice.leave |= next.is_some_and(|event| event <= now);
        self.end_slice_at(next);
    }

    /// The reset bits of the modelled blocks: each sits 20h before the enable bit.
    fn reset_bits(&self) -> [bool; BLOCKS.len()] {
        BLOCKS.map(|(_, _, enable)| {
            enable.is_some_and(|(register, bit)| self.rcc.plain(register - 0x20) & 1 << bit != 0)
        })
    }

    fn reset_blocks(&mut self, before: [bool; BLOCKS.len()]) {
        let after = self.reset_bits();
        for (index, (_, block, _)) in BLOCKS.into_iter().enumerate() {
            // Ports that the chip does not have have no reset bit either.
            if after[index] && !before[index] {
                self.block_mut(block).reset();
                self.tell_slave();
                self.wire_pins();
            }
        }
    }

    /// The CPU is about to run a straight run of code.
    pub fn fetch(&mut self, address: u32, size: u32) {
        if !self.flash.caches_code() {
            return;
        }
        let flash = self.geometry.flash;
        let behind = self.behind_alias(address).unwrap_or(address);
        if !flash.contains(behind, 1) {
            return;
        }
        let Some(old) = self.flash.fetch(behind - flash.base, size) else { return };
        let what = "the instruction cache has this line from before it was erased or programmed, and was not flushed \
                    (FLASH_ACR.ICRST while ICEN is clear): the chip may run the old code";
        self.report(Access::Fetch, flash.base + old, 16, 0, address, what.into());
    }

    /// The CPU is about to load from the flash array.
    pub fn load_flash(&mut self, address: u32, size: u32) {
        let address = self.behind_alias(address).unwrap_or(address);
        self.flash.load(address.wrapping_sub(self.geometry.flash.base) % self.geometry.flash.size, size);
        self.take_flash_changes();
    }

    /// The CPU stores into the flash array.
    pub fn store_flash(&mut self, address: u32, bytes: &[u8], pc: u32) {
        let now = self.now();
        let offset = address.wrapping_sub(self.geometry.flash.base) % self.geometry.flash.size;
        let erased_needed = {
            let array = &self.flash.array.bytes()[offset as usize..];
            array.iter().zip(bytes).any(|(old, new)| new & !old != 0)
        };
        let size = u8::try_from(bytes.len()).unwrap_or(u8::MAX);
        let mut word = [0; 4];
        for (to, from) in word.iter_mut().zip(bytes) {
            *to = *from;
        }
        let value = u32::from_le_bytes(word);
        match self.flash.store(offset, bytes, now) {
            Store::Started if erased_needed => {
                let what = "programs a 1 over a 0: the bit stays 0".into();
                self.report(Access::Write, address, size, value, pc, what);
            }
            Store::Started => {
                if let Some(what) = self.flash.weakness() {
                    self.report(Access::Write, address, size, value, pc, what);
                }
            }
            Store::Refused(why) => {
                self.report(Access::Write, address, size, value, pc, format!("flash not programmed: {why}"));
            }
        }
        self.settle_flash();
        self.after_write();
    }
}

/// Whether a register belongs to a counter that counts the core's cycles: SysTick, or the cycle counter of
/// the DWT.
#[must_use]
pub fn counts_cycles(address: u32) -> bool {
    Region::new(SCS + 0x10, 0x10).contains(address, 1) || Region::new(DWT, 8).contains(address, 1)
}

/// The byte-in-word address and bit that a bit-band alias offset stands for.
fn bit_band(base: u32, alias_offset: u32) -> (u32, u32) {
    let byte = alias_offset / 32;
    let bit = alias_offset / 4 % 8;
    (base + (byte & !3), bit + 8 * (byte & 3))
}

fn mask(size: u8) -> u32 {
    match size {
        1 => 0xFF,
        2 => 0xFFFF,
        _ => u32::MAX,
    }
}

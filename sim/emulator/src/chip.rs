//! Everything of the chip except the instruction set: memories, peripherals, clocks, and the
//! address map.

mod accesses;
pub(crate) mod memory_map;

use shared_abi::geometry::{Geometry, Region, SYSTEM_MEMORY};

use crate::bus::node::Pins;
use crate::bxcan::{self, BxCan};
use crate::circuit::Wired;
use crate::clock::CycleClock;
use crate::cortex::debug::Debug;
use crate::cortex::exceptions::{NMI, SYS_TICK};
use crate::cortex::scs::Scs;
use crate::memory::{HostMemory, PAGE};
use crate::options::Options;
use crate::periph::crc::Crc;
use crate::periph::exti::Exti;
use crate::periph::flash::Flash;
use crate::periph::gpio::Gpio;
use crate::periph::i2c::I2c;
use crate::periph::iwdg::Iwdg;
use crate::periph::otg::Otg;
use crate::periph::over_drive::{self, LEAST_SUPPLY};
use crate::periph::pwr::Pwr;
use crate::periph::rcc::{self, Clocks, Rcc, ResetCause};
use crate::periph::rtc::Rtc;
use crate::periph::syscfg::Syscfg;
use crate::periph::tim::{self, Tim};
use crate::periph::usart::{self, Usart};
use crate::periph::wwdg::Wwdg;
use crate::peripheral::Peripheral;
use crate::report::{Access, Report, Reports};
use crate::silicon::Silicon;
use crate::slice::Slice;
use crate::supply::{self, Supervisor, Supply};
use crate::time::{Span, Time};
use crate::variant::{self, Variant};
use memory_map::{
    Block, BANK, BLOCKS, FLASH_SIZE, OPTION_PAGE, OTP, OTP_BLOCK, OTP_BLOCKS, PATCHED, RCC_CFGR, SYSTEM,
    UNIQUE_ID,
};

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
    /// The same between two changes of the level at the pin of a watchdog chip.
    pub longest_between_toggles: Span,
}

/// Peripherals whose clocks software has just switched on ([`Silicon::late_clocks`]).
#[derive(Clone, Copy, Debug)]
struct LateClocks {
    /// The offset in RCC of the register, and the bits in it.
    register: u32,
    bits: u32,
    /// The run of code: its address and length, and the cycles at its start.
    run: (u32, u32, u64),
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
    /// The clocks of peripherals that were switched on last.
    late: Option<LateClocks>,
    /// The watchdog.
    pub iwdg: Iwdg,
    wwdg: Wwdg,
    /// The ports.
    pub gpio: Vec<Gpio>,
    pub(crate) circuit: Wired,
    /// CAN1 and CAN2.
    pub can: [BxCan; 2],
    /// The USARTs, as in [`usart::INSTANCES`].
    pub usarts: [Usart; 6],
    /// The timers, as in [`tim::INSTANCES`].
    tims: [Tim; 14],
    i2c: [I2c; 3],
    otg: Otg,
    pwr: Pwr,
    rtc: Rtc,
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
            supervisor: Supervisor::new(silicon),
            late: None,
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
            circuit: Wired::new(options.circuit),
            can: [BxCan::new().on(silicon), BxCan::slave().on(silicon)],
            usarts: usart::INSTANCES.each_ref().map(Usart::new),
            tims: tim::INSTANCES.each_ref().map(Tim::new),
            i2c: ["I2C1", "I2C2", "I2C3"].map(I2c::new),
            otg: Otg::default(),
            pwr: Pwr::new(variant, silicon),
            rtc: Rtc::default(),
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
                longest_between_toggles: Span(0),
            },
            slice: Slice::default(),
            hse_hz: options.hse_hz,
            is_halved: false,
            lines: Vec::new(),
        }
    }

    /// Programs one-time programmable bytes as a debug probe does: a bit only goes from 1 to 0, and one of a
    /// locked block stays. Returns whether all of these blocks could be programmed. `address` and the bytes
    /// are in `OTP`.
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

    /// The memory block of `address`, with the offset in it. Only plain memory, no peripherals.
    #[must_use]
    pub fn memory(&self, address: u32) -> Option<(&HostMemory, usize)> {
        let geometry = self.geometry;
        let address = self.behind_alias(address).unwrap_or(address);
        for (region, memory) in [
            (geometry.sram, &self.sram),
            (geometry.flash, &self.flash.array),
            (geometry.ccm, &self.ccm),
            (SYSTEM, &self.system),
            (OPTION_PAGE, &self.options),
        ] {
            if region.contains(address, 1) {
                return Some((memory, (address - region.base) as usize));
            }
        }
        None
    }

    /// Whether an address is in the flash, or in its alias.
    #[must_use]
    pub fn is_flash(&self, address: u32) -> bool {
        self.geometry.flash.contains(self.behind_alias(address).unwrap_or(address), 1)
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
        if !self.flash.options.boots_from_system_memory() || !is_empty {
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
        if cause == ResetCause::Pin {
            self.circuit.pin_reset(self.now());
        }
        self.iwdg.reset();
        match cause {
            ResetCause::Standby => self.pwr.leave_standby(),
            _ => self.pwr.reset(),
        }
        self.reset_core_domain(cause);
        if self.flash.options.hardware_watchdog() {
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

    /// The crystal of the board has this frequency from now on, 0 when it stops.
    pub fn set_crystal(&mut self, hz: u32) {
        self.hse_hz = hz;
        self.rcc.set_crystal(hz, self.now());
        self.follow_watchdog();
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
        self.rtc = Rtc::default();
    }

    /// Follows VDD.
    fn follow_supply(&mut self, now: Time) {
        let mv = self.supply.at(now);
        if let Some(change) = self.supervisor.watch(mv, self.flash.options.brown_out_level(), now) {
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

    /// The watchdog forces the LSI on, and the LSI carries its updates out. RTC follows its clock.
    fn follow_watchdog(&mut self) {
        let now = self.now();
        if self.iwdg.is_running() {
            self.rcc.force_lsi(now);
        }
        self.iwdg.follow_lsi(self.rcc.lsi_is_on(), now);
        self.rtc.follow(self.rcc.rtc_clock(), now);
    }

    fn reset_core_domain(&mut self, cause: ResetCause) {
        self.is_halved = false;
        for (_, block, _) in self.blocks() {
            if !matches!(block, Block::Iwdg | Block::Pwr) {
                self.block_mut(block).reset();
            }
        }
        if self.flash.options.boots_from_system_memory() {
            self.syscfg.boot_from_system_memory();
        }
        self.wire_pins();
        let option_bytes = self.flash.options.bytes();
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
        self.supervisor = Supervisor::new(self.silicon);
        self.circuit.power_on(now);
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

    /// Finds the pins that the program has assigned to the USARTs and the CAN controllers, and what it drives.
    fn wire_pins(&mut self) {
        let now = self.now();
        let Self { gpio, usarts, can, geometry, circuit, .. } = self;
        circuit.look(now, |(port, pin)| gpio.get(port as usize - 'A' as usize)?.driven(pin));
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
        let mut limits = self.geometry.line.limits_at(self.vdd);
        let mut without = "";
        if self.vdd >= LEAST_SUPPLY && self.pwr.over_drive().is_active(self.now()) {
            [limits.sysclk, limits.apb1, limits.apb2] = over_drive::LIMITS;
        } else if self.variant.has_over_drive() {
            without = " without over-drive (PWR_CSR.ODSWRDY)";
        }
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
        for (name, hz, most) in
            [("HCLK", hclk, limits.sysclk), ("PCLK1", pclk1, limits.apb1), ("PCLK2", pclk2, limits.apb2)]
        {
            if hz > most {
                wrong.push(format!("{name} is {hz} Hz, the chip's limit is {most}{without}"));
            }
        }
        if !wrong.is_empty() {
            self.report(Access::Write, RCC_CFGR, 4, self.rcc.cfgr(), self.slice.block.0, wrong.join("; "));
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
        } else if self.circuit.bites(now) {
            self.slice.reset_request = Some(ResetCause::Pin);
            self.slice.leave = true;
        } else if self.wwdg.has_expired() {
            self.slice.reset_request = Some(ResetCause::WindowWatchdog);
            self.slice.leave = true;
        }
        if self.scs.systick.advance(now) {
            self.scs.exceptions.pend(SYS_TICK);
        }
        if self.rcc.has_failed() {
            self.scs.exceptions.pend(NMI);
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
            self.circuit.next_event(),
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

    /// Sets the end of the CPU's run to the deadline or this event, whichever comes first.
    pub fn end_slice_at(&mut self, event: Option<Time>) {
        let until = self.stop_before(event);
        self.slice.end = self.clock.cycle_at(until);
    }

    /// Reports an access that is wrong or not modelled.
    pub fn report(&mut self, access: Access, address: u32, size: u8, value: u32, pc: u32, what: String) {
        let time = self.now();
        self.reports.add(Report { time, address, pc, size, access, value, what, count: 1 });
    }
}

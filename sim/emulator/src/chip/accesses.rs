//! Loads and stores of the CPU: from address to block (RM0090 section 2.1, bus architecture).

use super::memory_map::{
    Block, ClockEnable, Place, BLOCKS, DBGMCU, DWT, FPB, ITM, PERIPHERALS, PERIPHERAL_ALIAS, SCS, SRAM_ALIAS,
    SYSCFG_MEMRMP, UNMODELLED,
};
use super::{Chip, LateClocks};
use crate::cortex::exceptions::SYS_TICK;
use crate::cortex::scs::Effect;
use crate::costs::CRC_WORD;
use crate::memory::PAGE;
use crate::periph::flash::Store;
use crate::periph::rcc::{self, ResetCause};
use crate::periph::rtc::Rtc;
use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::report::{Access, Report};
use crate::time::Time;

impl Chip {
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

    /// The blocks of this chip: not each has all ports.
    pub(super) fn blocks(&self) -> impl Iterator<Item = (u32, Block, ClockEnable)> {
        let ports = self.gpio.len();
        BLOCKS.into_iter().filter(move |(_, block, _)| !matches!(block, Block::Gpio(port) if *port >= ports))
    }

    /// The block that answers at a word-aligned peripheral address.
    fn place(&self, address: u32) -> Place {
        let within = |base: u32, size: u32| Some(address.wrapping_sub(base)).filter(|&offset| offset < size);
        let block = self.blocks().find_map(|(base, block, enable)| {
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

    pub(super) fn block_mut(&mut self, block: Block) -> &mut dyn Peripheral {
        match block {
            Block::Crc => &mut self.crc,
            Block::Rcc => &mut self.rcc,
            Block::Flash => &mut self.flash,
            Block::Gpio(port) => &mut self.gpio[port],
            Block::Iwdg => &mut self.iwdg,
            Block::Wwdg => &mut self.wwdg,
            Block::Pwr => &mut self.pwr,
            Block::Rtc => &mut self.rtc,
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

    /// Whether a block's clock was switched on a moment ago, and nothing has waited for it.
    fn is_late(&self, enable: ClockEnable) -> bool {
        let (Some((register, bit)), Some(late)) = (enable, self.late) else { return false };
        late.register == register && late.bits & 1 << bit != 0 && late.run == self.run_of_code()
    }

    /// The clocks that were switched on are there.
    pub fn await_clocks(&mut self) {
        self.late = None;
    }

    fn run_of_code(&self) -> (u32, u32, u64) {
        let (address, len) = self.slice.block;
        (address, len, self.clock.cycles)
    }

    /// Whether the run of code has a DSB (ARMv7-M A7.7.34: F3BFh, 8F4Fh), which may stand before any access.
    fn has_barrier(&self) -> bool {
        let (address, len) = self.slice.block;
        let code = self
            .memory(address)
            .and_then(|(memory, offset)| memory.bytes().get(offset..offset + len as usize));
        code.is_some_and(|code| code.windows(4).step_by(2).any(|code| code == [0xBF, 0xF3, 0x4F, 0x8F]))
    }

    fn has_clock(&self, enable: ClockEnable) -> bool {
        enable.is_none_or(|(register, bit)| self.rcc.plain(register) & 1 << bit != 0)
    }

    /// The same while the core may be asleep: the low-power enable bits are 20h after the others (sections
    /// 7.3.15 to 7.3.19).
    pub(super) fn is_clocked(&self, enable: ClockEnable) -> bool {
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
            Place::Block { block, offset, enable } if self.has_clock(enable) && !self.is_late(enable) => {
                if block == Block::Rcc {
                    // The core waits for what it has written to this bus.
                    self.late = None;
                }
                self.block_mut(block).read(offset, now)
            }
            Place::Block { block, enable, .. } => {
                let name = self.block_mut(block).name();
                let yet = if self.is_late(enable) {
                    " yet: the register of its clock was not read back"
                } else {
                    ""
                };
                unmodelled(format!("{name} has no clock{yet} (RCC enables it); it reads as 0"))
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
            Place::Block { block, offset, enable } if self.has_clock(enable) && !self.is_late(enable) => {
                self.store_block(block, offset, value, now)
            }
            Place::Block { block, enable, .. } => {
                let name = self.block_mut(block).name();
                let yet = if self.is_late(enable) {
                    " yet: the register of its clock was not read back"
                } else {
                    ""
                };
                unmodelled(format!("{name} has no clock{yet} (RCC enables it); the write is lost"))
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
        let is_backup = block == Block::Rtc || block == Block::Rcc && offset == rcc::BDCR;
        if is_backup && !self.pwr.opens_backup_domain() {
            return unmodelled("the backup domain is write-protected (PWR_CR.DBP): the write is lost");
        }
        let resets_before = self.reset_bits();
        if block == Block::Exti && !self.exti.listens() {
            let levels = self.exti_levels();
            self.exti.settle(levels);
        }
        let caches_data = self.flash.caches_data();
        let clocks_before = self.rcc.plain(offset);
        self.pwr.set_pll_use(self.rcc.pll_use());
        let result = self.block_mut(block).write(offset, value, now);
        match block {
            Block::Rcc => {
                let bits = self.rcc.plain(offset) & !clocks_before;
                let is_clock = bits != 0 && (rcc::AHB1ENR..=rcc::APB2ENR).contains(&offset);
                if self.silicon.late_clocks && is_clock && !self.has_barrier() {
                    self.late = Some(LateClocks { register: offset, bits, run: self.run_of_code() });
                }
                self.reset_blocks(resets_before);
                let changed = self.rcc.clocks() != self.clocks;
                if changed || offset == rcc::APB1ENR || offset == rcc::APB2ENR {
                    self.apply_clocks();
                    self.slice.leave = true;
                }
                if changed {
                    self.check_clocks();
                }
                if self.rcc.resets_backup_domain() {
                    self.rtc = Rtc::default();
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
            Block::Syscfg => self.show_pins(),
            Block::Pwr => {
                if let Some(until) = self.pwr.over_drive().stall(now) {
                    self.slice.hold_until = Some(until);
                    self.slice.leave = true;
                }
                self.show_pins();
            }
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
    pub(super) fn settle_flash(&mut self) {
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

//! An STM32F405 that others wrote, QEMU's `netduinoplus2`, with what it lacks.
//!
//! QEMU has the core, NVIC, SysTick, bit-bands, flash as read-only memory, SRAM, and USART2 as far
//! as it receives. The registers of RCC, FLASH, CRC, PWR, GPIO, CAN and IWDG read as 0 and forget
//! what is stored, and at the unique ID is nothing. QEMU's stub for gdb stops the machine in front
//! of the accesses to [`LOADED`], [`STORED`], [`SHARED`] and the flash; this module then does what
//! the chip would do (RM0090): [`Chip`]. Flash operations take no time and the watchdog never bites.
//!
//! The time of the board is the time in which the machine runs; an access to CRC, RCC or FLASH
//! counts as 2 us, since a program that makes thousands of them in a row would seem slow.

use std::collections::{BTreeMap, VecDeque};
use std::io::{self, ErrorKind, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use super::access::{self, Access};
use super::remote::{Remote, PC, XPSR, XPSR_AT};

pub const FLASH: u32 = 0x0800_0000;
pub const FLASH_SIZE: u32 = 0x10_0000;

/// The firmware feeds the watchdog, which QEMU has not, every few milliseconds: so the machine does
/// not run on for long while nobody looks after it.
const IWDG_KR: u32 = 0x4000_3000;
const RCC_CR: u32 = 0x4002_3800;
const RCC_CFGR: u32 = 0x4002_3808;
const RCC_CSR: u32 = 0x4002_3874;
const PWR_CSR: u32 = 0x4000_7004;
const CRC_DR: u32 = 0x4002_3000;
const CRC_CR: u32 = 0x4002_3008;
const FLASH_ACR: u32 = 0x4002_3C00;
const FLASH_KEYR: u32 = 0x4002_3C04;
const FLASH_CR: u32 = 0x4002_3C10;
const FLASH_OPTCR: u32 = 0x4002_3C14;
const USART2_DR: u32 = 0x4000_4404;
const USART2_CR1: u32 = 0x4000_440C;
const TXEIE: u32 = 1 << 7;
const AIRCR: u32 = 0xE000_ED0C;
/// USART2 is line 38.
const ISPR1: u32 = 0xE000_E204;
const USART2_LINE: u32 = 1 << (38 - 32);

/// Unique ID and size of the flash (RM0090 section 39): QEMU has nothing there.
const UNIQUE_ID: [u32; 3] = [0x1FFF_7A10, 0x1FFF_7A14, 0x1FFF_7A18];
const SIZE_OF_FLASH: u32 = 0x1FFF_7A20;

/// Registers whose loads are answered here.
const LOADED: [u32; 12] = [
    RCC_CR,
    RCC_CFGR,
    RCC_CSR,
    PWR_CSR,
    CRC_DR,
    FLASH_ACR,
    FLASH_CR,
    FLASH_OPTCR,
    UNIQUE_ID[0],
    UNIQUE_ID[1],
    UNIQUE_ID[2],
    SIZE_OF_FLASH,
];
/// Registers whose stores do something here, and no more in QEMU.
const STORED: [u32; 10] =
    [IWDG_KR, RCC_CR, RCC_CFGR, RCC_CSR, CRC_DR, CRC_CR, FLASH_ACR, FLASH_KEYR, FLASH_CR, USART2_DR];
/// Registers whose stores do something in QEMU as well.
const SHARED: [u32; 2] = [USART2_CR1, AIRCR];

/// How long the host keeps silent after a frame of the device.
const REACTION: Duration = Duration::from_millis(20);
/// What the host may take for an access in a row.
const ROW: Duration = Duration::from_millis(5);

/// After the SRAM that the board has by its layout; QEMU's has 192 KiB.
const SCRATCH: u32 = 0x2002_F000;
/// A place there: the code, then the words that it loads.
const PLACE: u32 = 0x30;
const PLACES: u32 = 8;
/// ldr r0, line; ldr r1, ispr; str r0, [r1]; ldr r0, saved_r0; ldr r1, saved_r1; ldr.w pc, goes_on.
/// It makes USART2's interrupt pending, and changes nothing else.
const PEND: [u16; 7] = [0x4803, 0x4904, 0x6008, 0x4804, 0x4904, 0xF8DF, 0xF014];
/// The bits of xPSR with the state of an IT block.
const IT: u32 = 0x0600_FC00;

/// The sectors, by their first addresses and lengths (RM0090 table 5).
pub fn sectors() -> Vec<(u32, u32)> {
    let sizes = [&[16_u32; 4][..], &[64], &[128; 7]].concat();
    sizes
        .iter()
        .scan(FLASH, |at, kib| {
            let first = *at;
            *at += kib * 1024;
            Some((first, kib * 1024))
        })
        .collect()
}

/// What QEMU lacks.
struct Chip {
    values: BTreeMap<u32, u32>,
    crc: u32,
    /// Correct keys in a row.
    keys: usize,
    flash: Vec<u8>,
    unique_id: [u32; 3],
}

impl Chip {
    /// Reset values (RM0090 sections 7.3.26 and 3.9.13); `csr` says why.
    fn reset(&mut self, csr: u32) {
        self.values = [
            (RCC_CR, 0x83),
            (RCC_CFGR, 0),
            (RCC_CSR, csr),
            (FLASH_CR, 1 << 31),
            (FLASH_OPTCR, 0x0FFF_AAED),
            (USART2_CR1, 0),
        ]
        .into();
        self.crc = u32::MAX;
        self.keys = 0;
    }

    fn value(&self, register: u32) -> u32 {
        self.values.get(&register).copied().unwrap_or(0)
    }

    fn load(&self, register: u32) -> u32 {
        let value = self.value(register);
        match register {
            // HSEON, PLLON and their ready flags.
            RCC_CR => value & !0x0202_0002 | (value & 0x0101_0001) << 1,
            // SW, SWS.
            RCC_CFGR => value & !0xC | (value & 3) << 2,
            // VOSRDY.
            PWR_CSR => 1 << 14,
            CRC_DR => self.crc,
            SIZE_OF_FLASH => (FLASH_SIZE / 1024) << 16,
            _ => UNIQUE_ID.iter().position(|&it| it == register).map_or(value, |n| self.unique_id[n]),
        }
    }

    /// Returns the bytes of the flash that change.
    fn store(&mut self, register: u32, value: u32) -> Option<(u32, u32)> {
        let locked = self.value(FLASH_CR) & 1 << 31 != 0;
        match register {
            CRC_CR if value & 1 != 0 => self.crc = u32::MAX,
            CRC_DR => self.crc = crc_step(self.crc, value),
            // RMVF.
            RCC_CSR if value & 1 << 24 != 0 => drop(self.values.insert(RCC_CSR, 0)),
            FLASH_KEYR => {
                self.keys = if value == [0x4567_0123, 0xCDEF_89AB][self.keys] { self.keys + 1 } else { 0 };
                if self.keys == 2 {
                    self.keys = 0;
                    self.values.insert(FLASH_CR, self.value(FLASH_CR) & !(1 << 31));
                }
            }
            FLASH_CR if locked => {}
            FLASH_CR => {
                self.values.insert(FLASH_CR, value & !(1 << 16));
                // STRT and SER.
                if value & 0x1_0002 == 0x1_0002 {
                    let (address, len) = *sectors().get((value >> 3 & 0xF) as usize)?;
                    self.flash[(address - FLASH) as usize..][..len as usize].fill(0xFF);
                    return Some((address, len));
                }
            }
            _ => drop(self.values.insert(register, value)),
        }
        None
    }

    /// A store to the flash: programs if PG is set and the size is PSIZE (section 3.6.4). Otherwise
    /// the chip would report an error, which is not there: it ends the run.
    fn program(&mut self, address: u32, size: u32, value: u32) -> Option<(u32, u32)> {
        let cr = self.value(FLASH_CR);
        if cr & 1 == 0 || cr & 1 << 31 != 0 || 1 << (cr >> 8 & 3) != size {
            return None;
        }
        let cells = &mut self.flash[(address - FLASH) as usize..];
        for (cell, byte) in cells.iter_mut().zip(value.to_le_bytes()).take(size as usize) {
            *cell &= byte;
        }
        Some((address, size))
    }
}

/// The CRC unit with one more word (RM0090 section 4).
fn crc_step(crc: u32, word: u32) -> u32 {
    (0..32).fold(crc ^ word, |crc, _| if crc >> 31 == 1 { crc << 1 ^ 0x04C1_1DB7 } else { crc << 1 })
}

pub struct Board {
    qemu: Child,
    remote: Remote,
    serial: TcpStream,
    chip: Chip,
    runs: bool,
    /// The last access was one of those that come in rows.
    in_a_row: bool,
    /// Registers to be set before the machine runs on.
    set: Vec<(usize, u32)>,
    /// The place for the next [`PEND`].
    place: u32,
    /// Code that was read, by its address; for the program that runs now.
    code: BTreeMap<u32, Vec<u8>>,
    /// When the machine was let run last, and how long it ran before.
    since: Instant,
    ran: Duration,
    to_device: VecDeque<u8>,
    from_device: VecDeque<u8>,
    /// When the line is free for the next character.
    line_free: Duration,
    /// Lines that the device has not answered, and since when.
    unanswered: (u32, Duration),
    /// What the device says now.
    said: Vec<u8>,
    /// The accesses that were made here, by register; those to the flash as one.
    pub stops: BTreeMap<u32, u64>,
    /// Resets by the program.
    pub resets: u32,
}

impl Drop for Board {
    fn drop(&mut self) {
        let _ = self.qemu.kill();
        let _ = self.qemu.wait();
    }
}

fn free_port() -> io::Result<u16> {
    Ok(TcpListener::bind("127.0.0.1:0")?.local_addr()?.port())
}

impl Board {
    /// A board with this in its flash (from its start on; the rest is erased); its power comes up.
    pub fn power_on(flash: &[u8], unique_id: [u32; 3], log: &Path) -> io::Result<Self> {
        let line = TcpListener::bind("127.0.0.1:0")?;
        let gdb = free_port()?;
        let mut qemu = Command::new("qemu-system-arm");
        qemu.args(["-M", "netduinoplus2", "-display", "none", "-monitor", "none", "-S"]);
        qemu.args(["-gdb", &format!("tcp:127.0.0.1:{gdb}"), "-d", "unimp,guest_errors"]);
        qemu.arg("-D").arg(log);
        // Its time passes with the instructions, and not while the host does something else.
        qemu.args(["-icount", "shift=3,sleep=on"]);
        // USART1 has none.
        qemu.args(["-serial", "none"]);
        qemu.args(["-serial", &format!("tcp:{}", line.local_addr()?)]);
        let image = log.with_extension("flash");
        std::fs::write(&image, flash)?;
        qemu.args(["-device", &format!("loader,file={},addr={FLASH:#x},force-raw=on", image.display())]);
        let qemu = qemu.stdin(Stdio::null()).spawn()?;
        let mut remote = Remote::connect(gdb)?;
        let (serial, _) = line.accept()?;
        serial.set_nodelay(true)?;
        let mut cells = vec![0xFF; FLASH_SIZE as usize];
        cells[..flash.len()].copy_from_slice(flash);
        // QEMU's flash is 0 where nothing was loaded.
        remote.write(FLASH + flash.len() as u32, &cells[flash.len()..])?;
        for register in LOADED {
            remote.watch_loads(register)?;
        }
        for register in STORED.into_iter().chain(SHARED) {
            remote.watch_stores(register, 4)?;
        }
        remote.watch_stores(FLASH, FLASH_SIZE)?;
        let mut chip = Chip { values: BTreeMap::new(), crc: 0, keys: 0, flash: cells, unique_id };
        // PORRSTF, PINRSTF, BORRSTF.
        chip.reset(0x0E00_0000);
        Ok(Self {
            qemu,
            remote,
            serial,
            chip,
            runs: false,
            in_a_row: false,
            set: Vec::new(),
            place: 0,
            code: BTreeMap::new(),
            since: Instant::now(),
            ran: Duration::ZERO,
            to_device: VecDeque::new(),
            from_device: VecDeque::new(),
            line_free: Duration::ZERO,
            unanswered: (0, Duration::ZERO),
            said: Vec::new(),
            stops: BTreeMap::new(),
            resets: 0,
        })
    }

    /// How long the machine has run.
    pub fn time(&self) -> Duration {
        let now = if self.runs { self.since.elapsed() } else { Duration::ZERO };
        self.ran + if self.in_a_row { now.saturating_sub(ROW) } else { now }
    }

    /// What the flash holds, as the machine has it.
    pub fn flash(&mut self) -> io::Result<Vec<u8>> {
        self.halt()?;
        let flash = self.remote.read(FLASH, FLASH_SIZE as usize)?;
        if flash == self.chip.flash {
            Ok(flash)
        } else {
            Err(io::Error::new(ErrorKind::InvalidData, "QEMU's flash is not what was programmed"))
        }
    }

    /// The device receives this.
    pub fn send(&mut self, bytes: &[u8]) {
        self.to_device.extend(bytes);
    }

    /// What the device has sent.
    pub fn received(&mut self) -> &mut VecDeque<u8> {
        &mut self.from_device
    }

    fn halt(&mut self) -> io::Result<()> {
        while self.runs {
            self.remote.interrupt()?;
            if let Some(why) = self.remote.receive(Duration::from_secs(5))? {
                self.stopped(&why)?;
            }
        }
        Ok(())
    }

    /// Lets the machine run for a moment, and does what it asks for.
    pub fn run_for_a_moment(&mut self) -> io::Result<()> {
        if !self.runs {
            self.remote.run(&std::mem::take(&mut self.set))?;
            self.since = Instant::now();
            self.runs = true;
        }
        self.pass_on()?;
        if let Some(why) = self.remote.receive(Duration::from_micros(50))? {
            self.stopped(&why)?;
        }
        Ok(())
    }

    /// The device sends a character.
    fn said(&mut self, byte: u8) {
        self.from_device.push_back(byte);
        self.said.push(byte);
        if matches!(byte, b'\r' | 7) {
            let said = std::mem::take(&mut self.said);
            if matches!(said[0], b't' | b'T' | b'r' | b'R') {
                // The machine may be slower than the host's clock.
                self.line_free = self.line_free.max(self.time() + REACTION);
            } else {
                self.unanswered.0 = self.unanswered.0.saturating_sub(1);
            }
        }
    }

    /// The line: a character each 87 us, and not more than two lines ahead of the device's answers,
    /// since QEMU's USART takes a character as soon as the one before was read.
    fn pass_on(&mut self) -> io::Result<()> {
        let now = self.time();
        if self.unanswered.0 > 0 && now > self.unanswered.1 + Duration::from_millis(500) {
            self.unanswered.0 = 0;
        }
        if now >= self.line_free && self.unanswered.0 < 2 {
            if let Some(byte) = self.to_device.pop_front() {
                self.serial.write_all(&[byte])?;
                self.line_free = now + Duration::from_micros(87);
                if byte == b'\r' {
                    self.unanswered = (self.unanswered.0 + 1, now);
                }
            }
        }
        Ok(())
    }

    fn stopped(&mut self, why: &str) -> io::Result<()> {
        self.ran = self.time() + if self.in_a_row { Duration::from_micros(2) } else { Duration::ZERO };
        self.runs = false;
        self.in_a_row = false;
        if why.starts_with("T02") {
            return Ok(());
        }
        let registers = self.remote.registers()?;
        let pc = registers[PC];
        if !self.code.contains_key(&pc) {
            let code = self.remote.read(pc, 4)?;
            self.code.insert(pc, code);
        }
        let code = &self.code[&pc];
        let odd = || {
            let what = format!("QEMU stopped at {pc:08X}h ({code:02X?}): {why}");
            io::Error::new(ErrorKind::InvalidData, what)
        };
        let access = access::of(code, &registers).filter(|_| why.contains("watch:")).ok_or_else(odd)?;
        let register = access.address & !3;
        let in_flash = (FLASH..FLASH + FLASH_SIZE).contains(&access.address);
        *self.stops.entry(if in_flash { FLASH } else { register }).or_default() += 1;
        self.in_a_row = in_flash || (CRC_DR..=FLASH_OPTCR).contains(&register);
        if access.load {
            if !LOADED.contains(&register) {
                return Err(odd());
            }
            let value = self.chip.load(register) >> (8 * (access.address & 3));
            let value = if access.size < 4 { value & ((1 << (8 * access.size)) - 1) } else { value };
            self.set.push((access.register, value));
            self.skip(&registers, &access);
            return Ok(());
        }
        let value = registers[access.register];
        let before = self.chip.value(register);
        let changed = if in_flash {
            Some(self.chip.program(access.address, access.size, value).ok_or_else(odd)?)
        } else if SHARED.contains(&register) || STORED.contains(&register) {
            self.chip.store(register, value)
        } else {
            return Err(odd());
        };
        if let Some((address, len)) = changed {
            let cells = &self.chip.flash[(address - FLASH) as usize..][..len as usize];
            self.remote.write(address, cells)?;
        }
        match register {
            USART2_DR => {
                self.said(value as u8);
                self.skip(&registers, &access);
                self.pend_usart(&registers, pc + access.len)
            }
            // TXEIE lives here alone, and most stores change nothing.
            USART2_CR1 if (before ^ value) & !TXEIE == 0 => {
                self.skip(&registers, &access);
                if value & TXEIE & !before == 0 {
                    Ok(())
                } else {
                    self.pend_usart(&registers, pc + access.len)
                }
            }
            USART2_CR1 => {
                self.remote.step_over(register)?;
                self.pend_usart(&registers, pc + access.len)
            }
            AIRCR if value & 0xFFFF_0004 == 0x05FA_0004 => {
                self.resets += 1;
                self.code.clear();
                // PINRSTF and SFTRSTF beside the flags that are set.
                self.chip.reset(self.chip.value(RCC_CSR) | 0x1400_0000);
                self.remote.step_over(register)
            }
            AIRCR => self.remote.step_over(register),
            _ => {
                self.skip(&registers, &access);
                Ok(())
            }
        }
    }

    /// Goes on after an access that was made here.
    fn skip(&mut self, registers: &[u32; 17], access: &Access) {
        self.set.extend(access.write_back);
        let xpsr = registers[XPSR_AT];
        if xpsr & IT != 0 {
            // DDI 0403E A7.3.2, ITAdvance.
            let state = xpsr >> 8 & 0xFC | xpsr >> 25 & 3;
            let state = if state & 7 == 0 { 0 } else { state & 0xE0 | state << 1 & 0x1F };
            self.set.push((XPSR, xpsr & !IT | (state & 0xFC) << 8 | (state & 3) << 25));
        }
        self.set.push((PC, registers[PC] + access.len));
    }

    /// USART2's interrupt, if TXEIE is set: there is always room for the next character. Only the
    /// core reaches the registers of the NVIC, so it runs a few instructions before it goes on.
    fn pend_usart(&mut self, registers: &[u32; 17], goes_on: u32) -> io::Result<()> {
        if self.chip.value(USART2_CR1) & TXEIE == 0 {
            return Ok(());
        }
        if registers[XPSR_AT] & IT != 0 {
            return Err(io::Error::new(ErrorKind::InvalidData, "USART2 is written in an IT block"));
        }
        // The interrupt may come at once, and write to the USART.
        let place = SCRATCH + PLACE * self.place;
        self.place = (self.place + 1) % PLACES;
        let mut bytes: Vec<u8> = PEND.iter().flat_map(|half| half.to_le_bytes()).collect();
        bytes.resize(0x10, 0);
        for word in [USART2_LINE, ISPR1, registers[0], registers[1], goes_on | 1] {
            bytes.extend(word.to_le_bytes());
        }
        self.remote.run_with(place, &bytes, &[(PC, place)])?;
        self.set.clear();
        self.since = Instant::now();
        self.runs = true;
        Ok(())
    }
}

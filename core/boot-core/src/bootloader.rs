//! The bootloader as a CANopen device: its object dictionary and the download.

use core::task::Poll;

use canopen::bit_rate::BitRate;
use canopen::device::{self, Device};
use canopen::emcy::{self, Emcy};
use canopen::frame::Channel;
use canopen::line::LineEvent;
use canopen::lss::{LssAddress, LssDevice, StoreError};
use canopen::od::{put, Access, Address, DataType, Entry, Objects, Table};
use canopen::program::{
    control_count, ClockSource, FlashError, Numbers, ProgramControl, Supply, DATE_ENTRIES, DEVICE_STATE,
    ENABLE_FLASH, FLASH_STATUS, IDENTITY, PROGRAM_CONTROL, PROGRAM_DATA, PROGRAM_DATE, PROGRAM_ID,
    PROGRAM_PARTIAL, PROGRAM_REGION, PROGRAM_VERSION, RENEWAL_ENTRIES, ROM_LOADER, ROM_LOADER_ENTRIES,
    ROM_LOADER_SIGNATURE, SEALED_ENTRIES, SECOND_SERVER, SOFTWARE_VERSION, STATE_ENTRIES, STATE_LAST_REASON,
    STATE_OPTION_BYTES, STATE_PROGRAM_START, STATE_REASON, STATE_RELEASED, STATE_RENEWAL, STATE_STARTS,
    STATE_SUPPLY, STATE_VERSIONS, UNLOCK, UNLOCK_ENTRIES,
};
use canopen::sdo::second::{self, SecondServer};
use canopen::slave::SlaveDevice;
use canopen::{password::Lock, Instant};
use canopen::{AbortCode, NodeId};
use shared_abi::boot_report::{BootReport, Reason};
use shared_abi::date::days_and_milliseconds;
use shared_abi::layout::Layout;
use shared_abi::renewal::BOOTLOADER;
use shared_abi::warm_start::BootRequest;
use {canopen::program::ACCESS, seal::access::right};

use crate::choices::Has;
pub use crate::choices::{Choices, Everything, Extras, PasswordObject};
use crate::control::{Downloader, Policy, Sealed, Step};
use crate::decision::next_stay;
use crate::flash::Flash;
use crate::store::{NodeParameters, Parameters};
use crate::stored_version::StoredVersion;

/// The [`entry_count`] objects of a device with `programs` programs (1 to 254) and the objects of a
/// dialect (SYS TEC manual L-1112d_10, table 1).
#[must_use]
pub const fn entries<const LEN: usize>(programs: u8, extras: Extras) -> Table<LEN> {
    let data_access = if extras.read_back { Access::Rw } else { Access::Wo };
    let data = Entry::sub(PROGRAM_DATA, 1, "Program data of a program", DataType::Domain, data_access);
    let table = Table::<LEN>::EMPTY.with(&device::ENTRIES).with(&emcy::ENTRIES);
    let table = if extras.second_server { table.with(&second::ENTRIES) } else { table };
    let numbers = Numbers { programs, bootloader: extras.bootloader };
    let table = table.with_numbers("Program data", data, numbers).with_program_control(numbers);
    let table = table.with(&STATE_ENTRIES);
    let table = if extras.bootloader.is_some() { table.with(&RENEWAL_ENTRIES) } else { table };
    let table = if extras.resume {
        let element =
            Entry::sub(PROGRAM_PARTIAL, 1, "Begun download of a program", DataType::Unsigned64, Access::Ro);
        table.with_numbers("Begun download", element, Numbers::of_programs(programs))
    } else {
        table
    };
    let table = if extras.program_date { table.with(&DATE_ENTRIES) } else { table };
    let table = if extras.rom_loader { table.with(&ROM_LOADER_ENTRIES) } else { table };
    let table = if extras.sealed { table.with(&SEALED_ENTRIES) } else { table };
    match extras.password {
        PasswordObject::None => table,
        PasswordObject::Unlock => table.with(&UNLOCK_ENTRIES),
        PasswordObject::EnableFlash => {
            let name = "Enable flash programming of a program";
            let element = Entry::sub(ENABLE_FLASH, 1, name, DataType::Unsigned32, Access::Wo);
            table.with_numbers("Enable flash programming", element, numbers)
        }
    }
}

/// The number of entries in the object dictionary.
#[must_use]
pub const fn entry_count(programs: u8, extras: Extras) -> usize {
    let numbers = Numbers { programs, bootloader: extras.bootloader };
    let password = match extras.password {
        PasswordObject::None => 0,
        PasswordObject::Unlock => UNLOCK_ENTRIES.len(),
        PasswordObject::EnableFlash => numbers.entries(),
    };
    let sealed = if extras.sealed { SEALED_ENTRIES.len() } else { 0 };
    let second_server = if extras.second_server { second::ENTRIES.len() } else { 0 };
    let resume = if extras.resume { Numbers::of_programs(programs).entries() } else { 0 };
    let renewal = if extras.bootloader.is_some() { RENEWAL_ENTRIES.len() } else { 0 };
    let always = device::ENTRIES.len()
        + emcy::ENTRIES.len()
        + numbers.entries()
        + control_count(numbers)
        + STATE_ENTRIES.len()
        + renewal
        + if extras.program_date { DATE_ENTRIES.len() } else { 0 }
        + if extras.rom_loader { ROM_LOADER_ENTRIES.len() } else { 0 };
    always + password + sealed + second_server + resume
}

/// 1018h/4.
const SERIAL_NUMBER: u8 = 4;

/// So long after the start, or after the last work on the flash, the device is idle, in ms: a master that has
/// something to do has begun with it.
const IDLE_MS: u32 = 1000;

/// The configuration of a bootloader.
#[derive(Clone, Copy, Debug)]
pub struct Config {
    /// The object dictionary: [`entries`] for the programs of the layout.
    pub entries: &'static [Entry],
    /// The identity of the device. Each device replaces the serial number by its own.
    pub device: Device,
    /// The node-ID while the bootloader runs; `None` for the device's stored node-ID.
    pub node_id: Option<NodeId>,
    /// The memory layout: the owner of each address.
    pub layout: &'static Layout,
    /// Whether the CAN controller supports a bit rate.
    pub supports: fn(BitRate) -> bool,
    /// Whether an emergency follows each boot-up message. It shows a master that this is the
    /// bootloader and not the application. Its code is FF00h (device specific, CiA 301 table 26);
    /// its data are "BOOT" and the reason why the device stayed
    /// ([`Reason`]).
    pub boot_up_emergency: bool,
    /// How programs are downloaded.
    pub download: Policy,
    /// The password that unlocks 1F50h if [`Policy::locked`] is set; the client writes it to the
    /// object in [`Extras::password`].
    pub password: &'static [u8],
}

/// The objects of the bootloader and the state that they show.
pub struct Bootloader<'b, F: Flash, P: Parameters, const PROGRAMS: usize, C: Choices = Everything> {
    config: &'static Config,
    serial_number: u32,
    /// 2007h/1, 11, 3, 4 and 5.
    state: [u8; 5],
    /// Node-ID and bit rate as stored.
    node: NodeParameters,
    /// The active node-ID.
    id: Option<NodeId>,
    flash: F,
    download: Downloader<'b, P, PROGRAMS, C>,
    emcy: Emcy,
    second_server: SecondServer,
    /// The password.
    lock: Lock,
    /// The wait after wrong signatures. A password does not end it.
    signatures: Lock,
    /// The last time from [`set_time`](Self::set_time).
    now: Instant,
    /// An object of an update was written since the start.
    is_asked: bool,
    /// From this time on the device is idle, unless there is work on the flash before it.
    idle_at: Instant,
    stored_version: StoredVersion,
}

impl<'b, F: Flash, P: Parameters, const PROGRAMS: usize, C: Choices> Bootloader<'b, F, P, PROGRAMS, C> {
    /// Starts with the stored parameters, for a device that stayed in the bootloader as reported. The
    /// larger the `buffer`, the further the flash may lag behind the bus.
    #[allow(clippy::too_many_arguments, reason = "each is a part of the device")]
    pub fn new(
        config: &'static Config,
        serial_number: u32,
        node: NodeParameters,
        report: &BootReport,
        parameters: P,
        flash: F,
        buffer: &'b mut [u8],
        sealed: Sealed<'b>,
    ) -> Self {
        let mut download =
            Downloader::new(config.layout, &config.download, parameters, &flash, buffer, sealed);
        download.take_report(&flash, report);
        if report.reason == Reason::Compaction as u8 {
            download.compact(true);
        }
        let mut bootloader = Self {
            config,
            serial_number,
            state: [
                C::EXTRAS.bootloader.unwrap_or(0),
                report.reason,
                report.program_reset,
                report.crash_resets,
                0,
            ],
            node,
            id: config.node_id.or(node.id),
            flash,
            download,
            emcy: Emcy::new(),
            second_server: SecondServer::NONE,
            lock: Lock::new(config.password),
            signatures: Lock::new(b""),
            now: Instant::from_millis(0),
            is_asked: false,
            idle_at: Instant::from_millis(IDLE_MS),
            stored_version: StoredVersion::new(),
        };
        if report.reason == Reason::CrashLoop as u8 || report.reason == Reason::Fault as u8 {
            bootloader.emcy.raise(emcy::code::SOFTWARE, 0, [report.reason, 0, 0, 0, 0]);
        }
        bootloader
    }

    /// The active node-ID.
    #[must_use]
    pub fn node_id(&self) -> Option<NodeId> {
        self.id
    }

    /// Sets 2007h/5. From the internal oscillator, the emergency after the boot-up has bit 7 set in its
    /// last byte.
    pub fn set_clock_source(&mut self, source: ClockSource) {
        self.state[4] = source as u8;
    }

    /// The address of the device for layer setting services.
    #[must_use]
    pub fn lss_address(&self) -> LssAddress {
        LssAddress { serial_number: self.serial_number, ..self.config.device.lss_address() }
    }

    /// Continues the work on the flash with one bounded step.
    pub fn step(&mut self) -> Step {
        let step = self.download.step(&mut self.flash);
        self.report_outcome();
        if step != Step::Idle {
            self.idle_at = self.now + IDLE_MS;
        } else if self.download.compact(self.now.has_reached(self.idle_at)) {
            return Step::Again;
        }
        if C::READS_BACK && step == Step::Idle && self.config.download.read_back {
            return self.stored_version.step(&self.flash, self.download.installed(1));
        }
        step
    }

    /// Sets the current time; call this at least every few milliseconds.
    pub fn set_time(&mut self, now: Instant) {
        self.now = now;
        if C::RENEWS {
            self.download.watch_trial(now);
        }
    }

    /// The program of a sub-index: the bootloader has a number of its own.
    fn program(sub: u8) -> u8 {
        if C::EXTRAS.bootloader == Some(sub) {
            BOOTLOADER
        } else {
            sub
        }
    }

    /// Reports the result of work on the flash by an emergency.
    fn report_outcome(&mut self) {
        // No other success ends the wait: anybody may send a command that succeeds.
        if C::SEALED && self.download.rights_mut().take_authentic() {
            self.signatures.succeed();
        }
        match self.download.take_outcome() {
            None => {}
            Some((_, Ok(()))) => self.emcy.clear(emcy::register::MANUFACTURER),
            Some((program, Err(error))) => {
                // To check a signature takes the device a tenth of a second.
                if C::SEALED && self.download.rights().is_present() && error == FlashError::Signature {
                    self.signatures.fail(self.now);
                }
                let code = match error {
                    FlashError::Write | FlashError::Secured | FlashError::NvData => emcy::code::HARDWARE,
                    FlashError::NoAccess if self.flash.supply() == Supply::Low => emcy::code::HARDWARE,
                    _ => emcy::code::DATA_SET,
                };
                let program = match C::EXTRAS.bootloader {
                    Some(number) if program == BOOTLOADER => number,
                    _ => program,
                };
                self.emcy.raise(code, emcy::register::MANUFACTURER, [error.code(), program, 0, 0, 0]);
            }
        }
    }

    /// A value of 2007h that is a byte.
    fn state(&self, sub: u8) -> u8 {
        let place = match sub {
            STATE_SUPPLY => return self.flash.supply() as u8,
            STATE_REASON => return self.next_stay(),
            STATE_LAST_REASON => STATE_REASON,
            sub => sub,
        };
        self.state.get(usize::from(place).wrapping_sub(1)).copied().unwrap_or(0)
    }

    /// 2007h/2: what the boot stage would choose after a power-on now.
    fn next_stay(&self) -> u8 {
        let [_, reason, _, crash_resets, _] = self.state;
        let strap = C::entry_strap(reason == Reason::Strap as u8);
        let node_id = self.node.id_or_none();
        next_stay(strap, crash_resets.into(), node_id, C::DECISION, &self.download)
            .map_or(STATE_STARTS, |reason| reason as u8)
    }

    /// Whether [`Bootloader::step`] has work to do.
    #[must_use]
    pub fn busy(&self) -> bool {
        self.download.busy()
    }

    /// The program (0 for none) has returned the device to the bootloader: from now on it starts
    /// without a rescue window.
    pub fn confirm(&mut self, program: u8) {
        self.download.confirm(program);
    }

    /// Whether an object of an update was written since the start, be it the password: a master is at work.
    #[must_use]
    pub fn is_asked(&self) -> bool {
        self.is_asked
    }

    /// Whether the store is being compacted.
    #[must_use]
    pub fn is_compacting(&self) -> bool {
        self.download.is_compacting()
    }

    /// Whether a reset now would undo work that a host believes to be done or in progress.
    #[must_use]
    pub fn is_finishing(&mut self) -> bool {
        // A reset would end the wait after a wrong password, and so speed up guessing.
        if C::PASSWORD && self.lock.is_waiting(self.now) {
            return true;
        }
        if C::SEALED && self.download.rights().is_present() && self.signatures.remembers(self.now) {
            return true;
        }
        self.download.is_finishing()
    }

    /// Returns the request to leave the bootloader, once; the answer to the command may not have
    /// been sent yet.
    pub fn take_boot_request(&mut self) -> Option<BootRequest> {
        self.download.take_boot_request()
    }

    /// Ends all work at once, as a reset does, and returns flash and buffer. For tests and
    /// emulations that reset the device without resetting themselves.
    pub fn into_parts(self) -> (F, &'b mut [u8]) {
        (self.flash, self.download.into_buffer())
    }

    /// The flash of the device.
    pub fn flash(&mut self) -> &mut F {
        &mut self.flash
    }
}

impl<F: Flash, P: Parameters, const PROGRAMS: usize, C: Choices> Objects
    for Bootloader<'_, F, P, PROGRAMS, C>
{
    fn has_second_server() -> bool {
        C::SECOND_SERVER
    }

    fn has_block_download() -> bool {
        C::BLOCK_DOWNLOAD
    }

    fn has_block_upload() -> bool {
        C::BLOCK_UPLOAD
    }

    fn entries(&self) -> &'static [Entry] {
        self.config.entries
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        // Without a node-ID there is no SDO server.
        let Some(id) = self.id else { return Err(AbortCode::NO_DATA) };
        if let Some(read) = self.emcy.read(id, at, buf) {
            return read;
        }
        if C::READS_BACK && at == Address::new(SOFTWARE_VERSION, 0) {
            if let Some(version) = self.stored_version.text() {
                return put(buf, version);
            }
        }
        if let Some(read) = self.download.rights_mut().read(at, buf) {
            return read;
        }
        let program = Self::program(at.sub);
        let word = match at.index {
            PROGRAM_CONTROL => return put(buf, &[self.download.control(program) as u8]),
            PROGRAM_REGION => return put(buf, &self.download.region(program)),
            PROGRAM_PARTIAL if C::RESUMES => return put(buf, &self.download.partial(at.sub)),
            DEVICE_STATE if at.sub == STATE_PROGRAM_START => const { C::PROGRAM_START.to_word() },
            DEVICE_STATE if at.sub == STATE_OPTION_BYTES => self.flash.option_bytes(),
            DEVICE_STATE if at.sub == STATE_RELEASED => self.download.released(),
            DEVICE_STATE if C::RENEWS && at.sub == STATE_VERSIONS => {
                return put(buf, &self.download.versions());
            }
            DEVICE_STATE if C::RENEWS && at.sub == STATE_RENEWAL => {
                u32::from_le_bytes(self.download.renewal().bytes())
            }
            DEVICE_STATE => return put(buf, &[self.state(at.sub)]),
            PROGRAM_DATE if C::DATES => {
                let [date, time] = days_and_milliseconds(self.download.date());
                if at.sub == 1 {
                    date
                } else {
                    time
                }
            }
            PROGRAM_ID => self.download.identification(program),
            SECOND_SERVER if C::SECOND_SERVER => self.second_server.read(at.sub),
            FLASH_STATUS => self.download.status(program).to_word(),
            PROGRAM_VERSION => self.download.version(program),
            IDENTITY if at.sub == SERIAL_NUMBER => self.serial_number,
            _ => return self.config.device.read(at, buf).unwrap_or(Err(AbortCode::NO_DATA)),
        };
        put(buf, &word.to_le_bytes())
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        if let Some(written) = self.emcy.write(at, data) {
            return written;
        }
        // All other objects that can be written belong to an update.
        self.is_asked |= !C::SECOND_SERVER || at.index != SECOND_SERVER;
        match (at.index, data) {
            (ACCESS, request) if C::SEALED => {
                if self.signatures.is_waiting(self.now) {
                    return Err(AbortCode::DEVICE_STATE);
                }
                self.download.ask(&self.flash, request)
            }
            (SECOND_SERVER, &[a, b, c, d]) if C::SECOND_SERVER => {
                self.second_server.write(at.sub, u32::from_le_bytes([a, b, c, d]))
            }
            (ROM_LOADER, &[a, b, c, d]) if C::ROM_LOADER => {
                // A wrong signature: as of 1010h and 1011h (CiA 301 clause 7.5.2.13).
                if u32::from_le_bytes([a, b, c, d]) != ROM_LOADER_SIGNATURE {
                    return Err(AbortCode::STORE);
                }
                self.download.leave_for_rom_loader(&self.flash)
            }
            (PROGRAM_CONTROL, &[value]) => {
                self.download.command(Self::program(at.sub), ProgramControl::try_from(value)?)
            }
            (ENABLE_FLASH | UNLOCK, password) if C::PASSWORD => {
                self.lock.open(password, self.now)?;
                match at.index {
                    ENABLE_FLASH => self.download.unlock(Self::program(at.sub), true),
                    _ => self.download.unlock_all(),
                }
            }
            _ => Err(AbortCode::UNSUPPORTED_ACCESS),
        }
    }

    fn download_start(&mut self, at: Address, size: Option<u32>) -> Result<(), AbortCode> {
        self.is_asked = true;
        if C::SEALED && self.download.rights().takes_no_other() && self.signatures.is_waiting(self.now) {
            return Err(AbortCode::DEVICE_STATE);
        }
        self.download.download_start(&self.flash, Self::program(at.sub), size)
    }

    fn download_space(&mut self, _at: Address, held: bool) -> usize {
        self.download.space(held)
    }

    fn download_data(&mut self, _at: Address, data: &[u8]) -> Result<(), AbortCode> {
        self.download.download_data(data)
    }

    fn download_end(&mut self, _at: Address) -> Result<(), AbortCode> {
        let ended = self.download.download_end();
        self.report_outcome();
        ended
    }

    fn download_cancel(&mut self, _at: Address) {
        self.download.download_cancel();
    }

    fn upload_start(&mut self, at: Address) -> Result<Option<u32>, AbortCode> {
        if !C::READS_BACK {
            return Err(AbortCode::WRITE_ONLY);
        }
        self.download.stored(Self::program(at.sub)).map(|stored| Some(stored.size))
    }

    fn upload_data(&mut self, at: Address, offset: u32, buf: &mut [u8]) -> Result<usize, AbortCode> {
        if !C::READS_BACK {
            return Err(AbortCode::WRITE_ONLY);
        }
        let stored = self.download.stored(Self::program(at.sub))?;
        let rest = stored.size.saturating_sub(offset) as usize;
        let len = rest.min(buf.len());
        self.flash.read(stored.base + offset, &mut buf[..len]);
        Ok(len)
    }

    fn second_server(&self) -> Channel {
        if C::SECOND_SERVER {
            self.second_server.channel()
        } else {
            Channel::NONE
        }
    }

    fn next_emergency(&mut self) -> Option<[u8; 8]> {
        self.emcy.next_message()
    }
}

impl<F: Flash, P: Parameters, const PROGRAMS: usize, C: Choices> LssDevice
    for Bootloader<'_, F, P, PROGRAMS, C>
{
    fn has_lss() -> bool {
        C::LSS
    }

    fn identifies() -> bool {
        C::LSS_IDENTIFY
    }

    fn supports(&mut self, rate: BitRate) -> bool {
        (C::DETECTS_BIT_RATE || rate != BitRate::Auto) && (self.config.supports)(rate)
    }

    fn takes(&mut self, id: NodeId) -> bool {
        C::DECISION.node_ids.contains(&id.get())
    }

    fn store(&mut self, id: Option<NodeId>, rate: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        if !self.download.rights().permits(right::STORE) {
            return Poll::Ready(Err(StoreError::Failed));
        }
        if !C::LSS_STORE {
            return Poll::Ready(Err(StoreError::Unsupported));
        }
        let node = NodeParameters { id, bit_rate: rate.unwrap_or(self.node.bit_rate) };
        match self.download.store_node(node) {
            Ok(()) => {
                self.node = node;
                Poll::Pending
            }
            Err(_) => Poll::Ready(Err(StoreError::Failed)),
        }
    }

    fn stored(&mut self) -> Poll<Result<(), StoreError>> {
        self.download.node_stored().map_err(|_| StoreError::Failed)
    }
}

impl<F: Flash, P: Parameters, const PROGRAMS: usize, C: Choices> SlaveDevice
    for Bootloader<'_, F, P, PROGRAMS, C>
{
    fn line_event(&mut self, event: LineEvent) {
        self.emcy.line_event(event);
    }

    fn node_id_changed(&mut self, id: Option<NodeId>) {
        self.id = id;
        // Reset communication takes 1201h back to its default (CiA 301 clause 7.3.2.2.1).
        self.second_server = SecondServer::NONE;
        if id.is_some() && self.config.boot_up_emergency {
            let [_, reason, _, _, clock] = self.state;
            let reason = if clock == ClockSource::Internal as u8 { 0x80 | reason } else { reason };
            self.emcy.announce(emcy::code::DEVICE_SPECIFIC, [b'B', b'O', b'O', b'T', reason]);
        }
    }
}

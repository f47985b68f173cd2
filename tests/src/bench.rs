//! The bench: emulated boards with the built firmware on a bus, usually one board, and a port for
//! the host, all in virtual time.

use std::cell::{Cell, RefCell};
use std::rc::Rc;
use std::time::Duration;

use canopen::program::ProgramControl;
use canopen::{Address, BitRate, NodeId};
use coboot_can::{Adapter, AdapterError};
use coflash_core::device::{Doing, Error, Session, Timing};
use coflash_core::update::{flash, FlashOptions, Report};
use emulator::bus::{Outcome, Record};
use emulator::frame::Frame;
use emulator::machine::{Machine, Options, Stop, Usart};
use emulator::socketcand::Server;
use emulator::time::{Span, Time};
use emulator::world::{MachineId, PortId, World};

use crate::firmware;

/// How long a program that was never confirmed is delayed (`autostart.rescue_window_ms` of the product), in ms.
pub const RESCUE_WINDOW_MS: u64 = 300;

/// Presses the entry strap of a board, or releases it: a resistor then pulls it the other way, that of
/// the board or the chip's own. Returns whether the board has one.
pub fn press(machine: &mut Machine, pressed: bool) -> bool {
    let Some(strap) = bsp::ENTRY_STRAP else { return false };
    let level = match (pressed, strap.pull) {
        (true, _) => Some(strap.pressed),
        (false, bsp::Pull::None) => Some(!strap.pressed),
        (false, _) => None,
    };
    machine.set_pin(strap.port, strap.pin, level);
    true
}

/// The node-ID and bit rate of a board without stored values (bsp's board file).
pub const NODE: u8 = 1;
/// See [`NODE`].
pub const BIT_RATE: u32 = 125_000;
/// The identifiers of its SDO server and of its heartbeat (CiA 301, 7.3.3: predefined connection
/// set).
pub const REQUEST: u16 = 0x600 + NODE as u16;
/// See [`REQUEST`].
pub const RESPONSE: u32 = 0x580 + NODE as u32;
/// See [`REQUEST`].
pub const HEARTBEAT: u32 = 0x700 + NODE as u32;

/// The SDO request 1F51h/1 := value (CiA 301, 7.2.4.3.3).
pub const fn control(value: u8) -> [u8; 8] {
    [0x2F, 0x51, 0x1F, 1, value, 0, 0, 0]
}
/// Its acknowledgement.
pub const ACKNOWLEDGED: [u8; 8] = [0x60, 0x51, 0x1F, 1, 0, 0, 0, 0];

/// Boards on a bus.
pub struct Bench {
    /// The emulated world.
    pub world: World<Machine>,
    /// The board, or the first of several boards.
    pub device: MachineId,
    boards: Vec<MachineId>,
    port: PortId,
    heard: Rc<RefCell<Vec<Record>>>,
    clock: Rc<Cell<Time>>,
}

impl Bench {
    /// A board with the bootloader in its flash, still without power.
    pub fn new() -> Self {
        Self::with(Options::default())
    }

    /// The same on a given chip.
    ///
    /// # Panics
    /// If the emulator cannot be set up, or the firmware was not built.
    pub fn with(options: Options) -> Self {
        Self::of(firmware::BOOTLOADER, vec![options])
    }

    /// A board with this bootloader.
    pub fn of_image(bootloader: &str) -> Self {
        Self::of(bootloader, vec![Options::default()])
    }

    /// A board with this bootloader on a given chip.
    pub fn of_image_with(bootloader: &str, options: Options) -> Self {
        Self::of(bootloader, vec![options])
    }

    /// The same with the transceiver at this CAN controller, 1 or 2, instead of the board's own
    /// one.
    pub fn of_image_at(bootloader: &str, controller: u8) -> Self {
        Self::at(controller, bootloader, vec![Options::default()])
    }

    /// `count` boards with bootloaders with every option, each with its own unique ID and its own
    /// noise. They share bus and node-ID until they get others.
    ///
    /// # Panics
    /// As [`with`](Self::with), and for zero boards.
    pub fn of_boards(count: u32) -> Self {
        Self::of_boards_with(firmware::BOOTLOADER, count)
    }

    /// The same with this bootloader.
    ///
    /// # Panics
    /// As [`of_boards`](Self::of_boards).
    pub fn of_boards_with(bootloader: &str, count: u32) -> Self {
        let options = |n| {
            let Options { unique_id: [position, lot, more], .. } = Options::default();
            Options {
                seed: u64::from(n) + 1,
                unique_id: [position + n * 0x0001_0001, lot, more],
                ..Options::default()
            }
        };
        Self::of(bootloader, (0..count).map(options).collect())
    }

    fn of(bootloader: &str, chips: Vec<Options>) -> Self {
        Self::at(bsp::CAN_CONTROLLER, bootloader, chips)
    }

    fn at(controller: u8, bootloader: &str, chips: Vec<Options>) -> Self {
        let mut world = World::new();
        let heard = Rc::new(RefCell::new(Vec::new()));
        let ears = Rc::clone(&heard);
        world.add_sink(move |record| ears.borrow_mut().push(*record));
        let bootloader = firmware::elf(bootloader);
        let boards: Vec<MachineId> = chips
            .into_iter()
            .map(|options| {
                let options = Options {
                    transceiver: usize::from(controller) - 1,
                    // Without one, the crystal has failed.
                    hse_hz: if options.hse_hz == 0 { 0 } else { bsp::CLOCK_TREE.hse },
                    ..options
                };
                let mut machine = Machine::new(firmware::board().chip, options).expect("the emulator starts");
                machine.load(&bootloader).expect("the bootloader's ELF fits the flash");
                press(&mut machine, false);
                world.add_machine(machine)
            })
            .collect();
        let port = world.add_host_port(BIT_RATE);
        Self { world, device: boards[0], boards, port, heard, clock: Rc::default() }
    }

    /// The board, or the first of several boards.
    pub fn machine(&mut self) -> &mut Machine {
        self.world.machine_mut(self.device)
    }

    /// The USART of the first board's firmware.
    ///
    /// # Panics
    /// If the firmware uses none.
    pub fn usart(&mut self) -> &mut Usart {
        let mut usarts = self.machine().usarts_mut().iter_mut();
        usarts.find(|usart| usart.accesses() > 0).expect("firmware that uses a USART")
    }

    /// All boards, as [`World::machine_mut`] names them.
    pub fn boards(&self) -> Vec<MachineId> {
        self.boards.clone()
    }

    /// Virtual time.
    pub fn time(&self) -> Time {
        self.world.now()
    }

    /// Virtual time while a session borrows the bench: the time of the host's last access to the
    /// bus.
    pub fn clock(&self) -> Rc<Cell<Time>> {
        Rc::clone(&self.clock)
    }

    /// Sets another bit rate for the host.
    pub fn set_host_bit_rate(&mut self, bit_rate: u32) {
        self.world.port_mut(self.port).set_bit_rate(bit_rate);
    }

    /// Switches the power of all boards on.
    pub fn power_on(&mut self) {
        for board in self.boards() {
            self.world.power_on(board);
        }
    }

    /// Switches the power on; returns the time until the program counter is in program 1, in steps
    /// of 10 us.
    ///
    /// # Panics
    /// If the program does not start within a second.
    pub fn power_on_to_first_instruction(&mut self) -> Span {
        self.power_on();
        self.run_to_first_instruction()
    }

    /// The same from now on, without the power.
    ///
    /// # Panics
    /// If the program does not start within a second.
    pub fn run_to_first_instruction(&mut self) -> Span {
        let from: Time = self.time();
        loop {
            self.world.run_for(Span::from_micros(10));
            if firmware::board().programs[0].contains(self.machine().pc(), 2) {
                return self.time() - from;
            }
            assert!(self.time() - from < Span::from_millis(1000), "the program does not start");
        }
    }

    /// Cuts the power of all boards.
    pub fn power_off(&mut self) {
        for board in self.boards() {
            self.world.power_off(board);
        }
    }

    /// Writes zeros to the end of the flash of every program, and to the end of every sector in it,
    /// as a debug probe could: each sector must then be erased before anything can be written.
    pub fn soil_programs(&mut self) {
        let board = firmware::board();
        for program in board.programs {
            let mut at = program.base;
            while let Some(sector) = board.chip.sector_at(at).filter(|_| at < program.end()) {
                at = sector.region.end();
                self.machine().load_bin(at - 4, &[0; 4]).expect("it is in flash");
            }
        }
    }

    /// Writes the last record of the journal into its free slots but the last `left`, as a debug probe could.
    pub fn fill_journal(&mut self, left: usize) {
        /// Seven words.
        const SLOT: usize = 28;
        for region in firmware::board().parameters {
            let mut bytes = self.memory(region.base, region.size as usize);
            let used = bytes.iter().rposition(|byte| *byte != 0xFF).map_or(0, |last| last + 1);
            let free = used.next_multiple_of(SLOT);
            // A header, and a record.
            if free >= 2 * SLOT {
                let record = bytes[free - SLOT..free].to_vec();
                let slots = (bytes.len() - free) / SLOT;
                let taken = bytes[free..].chunks_exact_mut(SLOT).take(slots.saturating_sub(left));
                taken.for_each(|slot| slot.copy_from_slice(&record));
                self.machine().load_bin(region.base, &bytes).expect("it is in flash");
            }
        }
    }

    /// The contents of memory, as a debug probe reads them.
    ///
    /// # Panics
    /// If there is no memory.
    pub fn memory(&self, address: u32, len: usize) -> Vec<u8> {
        let mut bytes = vec![0; len];
        self.world.machine(self.device).read_memory(address, &mut bytes).expect("memory");
        bytes
    }

    /// A word of it.
    ///
    /// # Panics
    /// If there is no memory.
    pub fn word(&self, address: u32) -> u32 {
        u32::from_le_bytes(self.memory(address, 4).try_into().expect("four bytes"))
    }

    /// Runs for this time.
    pub fn run_ms(&mut self, ms: u64) {
        self.world.run_for(Span::from_millis(ms));
    }

    /// Runs until the board sends its boot-up message; returns the time of it.
    ///
    /// # Panics
    /// If this takes more than `within_ms`.
    pub fn await_boot_up(&mut self, within_ms: u64) -> Time {
        self.await_boot_up_of(NODE, within_ms)
    }

    /// Runs until a node sends its boot-up message; returns the time of it.
    ///
    /// # Panics
    /// If this takes more than `within_ms`.
    pub fn await_boot_up_of(&mut self, node: u8, within_ms: u64) -> Time {
        let from = self.time();
        let deadline = from + Span::from_millis(within_ms);
        loop {
            match self.world.run_until_frame_or(self.port, deadline) {
                Some((at, frame)) if frame.raw_id() == 0x700 + u32::from(node) && frame.data() == [0] => {
                    return at
                }
                Some(_) => {}
                None => {
                    let said = self.frames_since(from);
                    panic!("no boot-up of node {node} within {within_ms} ms; the bus said {said:?}")
                }
            }
        }
    }

    /// Runs until the program that starts by itself runs; returns the time of its boot-up message.
    /// A bootloader with a rescue window sends its own boot-up message before.
    ///
    /// # Panics
    /// If the first boot-up takes more than `within_ms`.
    pub fn await_program_of(&mut self, node: u8, within_ms: u64) -> Time {
        let first = self.await_boot_up_of(node, within_ms);
        let deadline = first + Span::from_millis(RESCUE_WINDOW_MS + 50);
        while let Some((at, frame)) = self.world.run_until_frame_or(self.port, deadline) {
            if frame.raw_id() == 0x700 + u32::from(node) && frame.data() == [0] {
                return at;
            }
        }
        first
    }

    /// The same for the board's own node-ID.
    ///
    /// # Panics
    /// As [`await_program_of`](Self::await_program_of).
    pub fn await_program(&mut self, within_ms: u64) -> Time {
        self.await_program_of(NODE, within_ms)
    }

    /// Calls the running program back: the bootloader has sent its boot-up message, at this time.
    ///
    /// # Panics
    /// If the device does not return.
    pub fn call_back(&mut self) -> Time {
        self.session().command(1, ProgramControl::StartBootloader).expect("it is answered");
        self.await_boot_up(100)
    }

    /// Starts program 1 from the bootloader: it has sent its boot-up message, at this time.
    ///
    /// # Panics
    /// If it does not start.
    pub fn start_program(&mut self) -> Time {
        self.session().command(1, ProgramControl::Start).expect("it is answered");
        self.await_boot_up(100)
    }

    /// Makes the running program call the bootloader, which confirms the program, and starts it
    /// again.
    ///
    /// # Panics
    /// If the device does not return, or the program does not start.
    pub fn confirm_program(&mut self) {
        self.call_back();
        self.run_ms(20);
        self.start_program();
    }

    /// Switches the board on: it has sent its boot-up message, at this time.
    ///
    /// # Panics
    /// If it does not start.
    pub fn switch_on(&mut self) -> Time {
        self.power_on();
        self.await_boot_up(100)
    }

    /// The same with the board.
    #[must_use]
    pub fn switched_on(mut self) -> Self {
        self.switch_on();
        self
    }

    /// Switches the power off for 100 ms, and on.
    pub fn power_cycle(&mut self) {
        self.power_off();
        self.run_ms(100);
        self.power_on();
    }

    /// The same; the program runs.
    ///
    /// # Panics
    /// If it does not start.
    pub fn restart(&mut self) {
        self.power_cycle();
        self.await_program(1000);
        self.events();
    }

    /// Protects the parameters against writing, as somebody could by the option bytes, or no longer.
    pub fn protect_parameters(&mut self, is_protected: bool) {
        let board = firmware::board();
        for region in board.parameters {
            let sector = board.chip.sector_at(region.base).expect("it is in flash");
            self.machine().protect_sector(sector.number, is_protected);
        }
    }

    /// Writes these words to the warm-start cell.
    pub fn set_warm_start(&mut self, words: [u32; 4]) {
        let bytes = words.map(u32::to_le_bytes).concat();
        self.machine().write_ram(firmware::board().warm_start.base, &bytes).expect("it is in RAM");
    }

    /// Overwrites the instruction at which the core sleeps: `idle` is in RAM.
    ///
    /// # Panics
    /// If the core does not sleep in RAM.
    pub fn replace_idle(&mut self, instruction: u16) {
        let at = self.machine().pc();
        self.machine().write_ram(at, &instruction.to_le_bytes()).expect("idle sleeps in RAM");
    }

    /// The boot-up messages after this start: one of the program, and one before it of the
    /// bootloader if the program has a rescue window.
    pub fn boot_ups(&mut self, start: fn(&mut Self)) -> usize {
        let from = self.time();
        start(self);
        self.run_ms(RESCUE_WINDOW_MS + 200);
        self.frames_of(HEARTBEAT, from).iter().filter(|(_, data)| data[..] == [0]).count()
    }

    /// The machine of the running application moves from now on, or stands: of the template by the
    /// word of its interlock, of the probe in C by its object.
    ///
    /// # Panics
    /// If the application has no machine.
    pub fn move_machine(&mut self, image: &str, moves: bool) {
        if image == firmware::APP_C_PROBE {
            let word = u32::from(moves).to_le_bytes();
            let at = Address::new(0x2100, 16);
            self.session().write(at, &word, Doing::Write(at), &mut |_| {}).expect("an object of the probe");
        } else {
            let word = firmware::symbol(image, |name| name.contains("7MACHINE"));
            self.machine().write_ram(word, &[u8::from(moves)]).expect("in RAM");
        }
    }

    /// Every good frame that began at or after this time, as identifier and data.
    pub fn frames_since(&self, from: Time) -> Vec<(Time, u32, Vec<u8>)> {
        let heard = self.heard.borrow();
        let good = heard.iter().filter(|record| record.start >= from && record.outcome == Outcome::Good);
        good.map(|record| (record.end, record.frame.raw_id(), record.frame.data().to_vec())).collect()
    }

    /// The same of the frames with this identifier.
    pub fn frames_of(&self, id: u32, from: Time) -> Vec<(Time, Vec<u8>)> {
        let frames = self.frames_since(from).into_iter().filter(|(_, of, _)| *of == id);
        frames.map(|(at, _, data)| (at, data)).collect()
    }

    /// The emergencies of the board with [`NODE`].
    pub fn emergencies(&self, from: Time) -> Vec<Vec<u8>> {
        self.frames_of(0x80 + u32::from(NODE), from).into_iter().map(|(_, data)| data).collect()
    }

    /// Every record of the bus so far, including errors.
    pub fn records(&self) -> Vec<Record> {
        self.heard.borrow().clone()
    }

    /// The same since the last call, for attacks that last long: the bench forgets them.
    pub fn take_records(&mut self) -> Vec<Record> {
        std::mem::take(&mut *self.heard.borrow_mut())
    }

    /// Throws away the frames that the host has received and not fetched.
    pub fn forget_received(&mut self) {
        while self.world.receive(self.port).is_some() {}
    }

    /// The resets and other events of the board that were not read yet.
    pub fn events(&mut self) -> Vec<(Time, Stop)> {
        std::iter::from_fn(|| self.world.news()).map(|news| (news.at, news.stop)).collect()
    }

    /// The same without their times.
    pub fn stops(&mut self) -> Vec<Stop> {
        self.events().into_iter().map(|(_, stop)| stop).collect()
    }

    /// Sends a raw frame from the host, and does not wait.
    ///
    /// # Panics
    /// If the frame is invalid.
    pub fn post(&mut self, id: u16, data: &[u8]) {
        self.world.send(self.port, Frame::standard(id, data).expect("11 bits, 8 bytes"));
    }

    /// Sends a raw frame from the host and returns the next frame with identifier `answer`, within
    /// 100 ms.
    ///
    /// # Panics
    /// If the frame is invalid.
    pub fn ask(&mut self, id: u16, data: &[u8], answer: u32) -> Option<Vec<u8>> {
        self.post(id, data);
        self.answer(answer)
    }

    /// The same; the frame must be this one.
    #[track_caller]
    pub fn assert_answer(&mut self, id: u16, data: &[u8], answer: u32, expected: &[u8]) {
        assert_eq!(self.ask(id, data, answer).as_deref(), Some(expected), "to {data:02X?}");
    }

    /// The next frame with this identifier, within 100 ms.
    fn answer(&mut self, id: u32) -> Option<Vec<u8>> {
        let deadline = self.time() + Span::from_millis(100);
        loop {
            let (_, frame) = self.world.run_until_frame_or(self.port, deadline)?;
            if frame.raw_id() == id {
                return Some(frame.data().to_vec());
            }
        }
    }

    /// A board in its bootloader, at this bit rate.
    ///
    /// # Panics
    /// If it refuses the bit rate.
    pub fn at_rate(rate: BitRate) -> Self {
        let mut bench = Self::new();
        bench.commission(bench.device, NODE, rate);
        bench.set_host_bit_rate(rate.bits_per_second().expect("a rate that can be set"));
        bench.switch_on();
        bench
    }

    /// A board at this bit rate that runs this application.
    ///
    /// # Panics
    /// If it cannot be installed.
    pub fn running(rate: BitRate, image: &str) -> Self {
        let mut bench = Self::at_rate(rate);
        bench.install(image);
        bench.run_ms(100);
        bench.events();
        bench
    }

    /// Installs an application of the board, without a trial run, and starts it.
    ///
    /// # Panics
    /// If the board does not take it.
    pub fn install(&mut self, image: &str) -> Report {
        let options = FlashOptions::default().trial_run(false);
        flash(&mut self.session(), firmware::blocks(image), &options, &mut |_| {}).expect("it is installed")
    }

    /// The same without a watch over the program, which one that does not feed its watchdog does not outlive.
    ///
    /// # Errors
    /// The board does not take it.
    pub fn install_unwatched(&mut self, image: &str) -> Result<Report, Error> {
        let options = FlashOptions::default().trial_run(false).watch(Some(Duration::ZERO));
        flash(&mut self.session(), firmware::blocks(image), &options, &mut |_| {})
    }

    /// The whole procedure of the tool with its default options.
    ///
    /// # Panics
    /// If it fails.
    pub fn update(&mut self, image: &str) -> Report {
        let options = FlashOptions::default();
        flash(&mut self.session(), firmware::blocks(image), &options, &mut |_| {}).expect("an update")
    }

    /// Reads a number of up to 32 bits.
    ///
    /// # Panics
    /// If the board has another answer.
    pub fn number(&mut self, index: u16, sub: u8) -> u32 {
        self.session().read_number(Address::new(index, sub)).expect("a number")
    }

    /// Reads a text.
    ///
    /// # Panics
    /// If the board has another answer.
    pub fn text(&mut self, index: u16) -> String {
        self.session().read_text(Address::new(index, 0)).expect("a text")
    }

    /// Sends frames of eight bytes with each data length code that means eight (ISO 11898-1:2015, table 5), to
    /// all nodes and to the SDO server, and remote frames. They are as good as those with 8: a request of SDO
    /// is answered; an NMT command has two bytes (CiA 301 section 7.2.8.3.1), so these are none.
    ///
    /// # Panics
    /// If the board with [`NODE`] has another answer, or is reset.
    pub fn assert_takes_every_dlc(&mut self) {
        const READ: [u8; 8] = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
        let answer = self.ask(REQUEST, &READ, RESPONSE);
        self.events();
        for dlc in 9..=15 {
            for (id, data) in [(0x000, [0x81; 8]), (0x7E5, [0x5E, 0, 0, 0, 0, 0, 0, 0]), (REQUEST, READ)] {
                let frame = Frame::standard(id, &data).and_then(|frame| frame.with_dlc(dlc));
                let remote = frame.and_then(|frame| Frame::remote_frame(frame.id(), dlc));
                for frame in [remote, frame] {
                    self.world.send(self.port, frame.expect("four bits"));
                }
            }
            assert!(answer.is_some() && self.answer(RESPONSE) == answer, "DLC {dlc}");
        }
        self.run_ms(100);
        assert_eq!(self.events(), [], "it is reset");
    }

    /// Stores node-ID (255 for none) and bit rate by layer setting services (CiA 305) in the board that is alone on
    /// the bus; they are in force from its next reset on.
    #[track_caller]
    pub fn store_by_lss(&mut self, node: u8, rate: BitRate) {
        // Switch state global: configuration. Configure node-ID, bit timing (of table 0). Store.
        self.post(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
        for [command, a, b] in [[0x11, node, 0], [0x13, 0, rate as u8], [0x17, 0, 0]] {
            let request = [command, a, b, 0, 0, 0, 0, 0];
            self.assert_answer(0x7E5, &request, 0x7E4, &[command, 0, 0, 0, 0, 0, 0, 0]);
        }
    }

    /// Configures a board as in the factory: sets its node-ID (255 for none) and bit rate by layer
    /// setting services while it is alone on the bus (the others have no power), and stores them.
    /// Returns the board's serial number, and switches it off.
    ///
    /// # Panics
    /// If the board refuses, or does not answer as [`NODE`] at [`BIT_RATE`] like a new board.
    pub fn commission(&mut self, board: MachineId, node: u8, rate: BitRate) -> u32 {
        self.world.power_on(board);
        self.await_boot_up(100);
        let serial = self.session().read_number(Address::new(0x1018, 4)).expect("a serial number");
        self.store_by_lss(node, rate);
        self.world.power_off(board);
        serial
    }

    /// Lets the endpoint's clients take part until the time `until`; returns the number of frames
    /// that they got.
    pub fn serve(&mut self, server: &mut Server, until: Time) -> usize {
        let before = server.exchange(&mut self.world, self.port);
        self.world.run_until(until);
        before + server.exchange(&mut self.world, self.port)
    }

    /// A host's session with the board.
    pub fn session(&mut self) -> Session<'_> {
        self.session_with(NODE)
    }

    /// A host's session with a node.
    ///
    /// # Panics
    /// If the node-ID is invalid.
    pub fn session_with(&mut self, node: u8) -> Session<'_> {
        let node = NodeId::new(node).expect("1 to 127");
        Session::new(self, node, Timing::default())
    }

    /// Whether a node answers as a bootloader and not as an application.
    ///
    /// # Panics
    /// If it does not answer.
    pub fn is_bootloader(&mut self, node: u8) -> bool {
        let device_type = self.session_with(node).device_type().expect("an answer");
        device_type.expect("1000h is mandatory").is_bootloader()
    }

    /// Fails if the firmware of any board accessed anything that the emulator does not model.
    ///
    /// # Panics
    /// With the list of these accesses.
    pub fn assert_nothing_unmodelled(&mut self) {
        for board in self.boards() {
            let reports = self.world.machine_mut(board).reports();
            assert!(
                reports.is_empty(),
                "the firmware touched what the emulator does not model: {reports:#?}"
            );
        }
    }
}

impl Default for Bench {
    fn default() -> Self {
        Self::new()
    }
}

/// The code of an abort; `None` for a success.
///
/// # Panics
/// If it is another error.
#[track_caller]
pub fn abort_code<T>(outcome: Result<T, Error>) -> Option<u32> {
    match outcome {
        Ok(_) => None,
        Err(Error::Refused { code, .. }) => Some(code.0),
        Err(error) => panic!("{error}"),
    }
}

/// A frame in the type of another crate; `None` for one that is invalid there.
pub fn convert<F: embedded_can::Frame, G: embedded_can::Frame>(frame: &F) -> Option<G> {
    if frame.is_remote_frame() {
        G::new_remote(frame.id(), frame.dlc())
    } else {
        G::new(frame.id(), frame.data())
    }
}

/// The host's access to the bus, in virtual time: the board runs while the host waits.
impl Adapter for Bench {
    fn send(&mut self, frame: &canopen::Frame) -> Result<(), AdapterError> {
        if let Some(frame) = convert(frame) {
            self.world.send(self.port, frame);
        }
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<canopen::Frame>, AdapterError> {
        let nanos = u64::try_from(timeout.as_nanos()).unwrap_or(u64::MAX / 1000);
        let deadline = self.world.now() + Span::from_nanos(nanos);
        let received = self.world.run_until_frame_or(self.port, deadline);
        self.clock.set(self.world.now());
        Ok(received.and_then(|(_, frame)| convert(&frame)))
    }

    fn now(&self) -> Duration {
        Duration::from_nanos(self.world.now().0 / 1000)
    }
}

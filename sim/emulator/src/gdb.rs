//! The gdb door: the remote serial protocol of gdb over TCP, for one machine.
//!
//! A debugger that connects halts the machine, and with it all virtual time. When the debugger
//! disconnects, in whatever state, the machine goes on without breakpoints. One debugger is served
//! at a time; the next one waits until the first has left. The crate `gdbstub` implements the
//! protocol itself.

use std::convert::Infallible;
use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::sync::mpsc::{sync_channel, Receiver, SyncSender};
use std::thread::{self, Thread};
use std::time::Duration;

use gdbstub::arch::{Arch, Registers};
use gdbstub::common::Signal;
use gdbstub::conn::Connection;
use gdbstub::outputln;
use gdbstub::stub::state_machine::GdbStubStateMachine;
use gdbstub::stub::{GdbStub, SingleThreadStopReason};
use gdbstub::target::ext::base::singlethread::{
    SingleThreadBase, SingleThreadResume, SingleThreadResumeOps, SingleThreadSingleStep,
    SingleThreadSingleStepOps,
};
use gdbstub::target::ext::base::BaseOps;
use gdbstub::target::ext::breakpoints::{
    Breakpoints, BreakpointsOps, HwBreakpoint, HwBreakpointOps, SwBreakpoint, SwBreakpointOps,
};
use gdbstub::target::ext::monitor_cmd::{ConsoleOutput, MonitorCmd, MonitorCmdOps};
use gdbstub::target::{Target, TargetError, TargetResult};

use crate::machine::{Halt, Machine};

/// Pieces of received bytes that may wait for the owner of the machine.
const EVENTS: usize = 64;
/// A debugger that does not read an answer for this long is disconnected.
const PATIENCE: Duration = Duration::from_secs(5);

/// A Cortex-M as gdb sees it.
#[derive(Debug)]
pub enum CortexM {}

/// r0 to r12, SP, LR, PC, xPSR.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CoreRegisters([u32; 17]);

impl Arch for CortexM {
    type Usize = u32;
    type Registers = CoreRegisters;
    type BreakpointKind = usize;
    type RegId = ();

    /// The GDB manual, section G.5.3, ARM features.
    fn target_description_xml() -> Option<&'static str> {
        Some(concat!(
            r#"<?xml version="1.0"?><!DOCTYPE target SYSTEM "gdb-target.dtd"><target version="1.0">"#,
            r#"<architecture>arm</architecture><feature name="org.gnu.gdb.arm.m-profile">"#,
            r#"<reg name="r0" bitsize="32"/><reg name="r1" bitsize="32"/>"#,
            r#"<reg name="r2" bitsize="32"/><reg name="r3" bitsize="32"/>"#,
            r#"<reg name="r4" bitsize="32"/><reg name="r5" bitsize="32"/>"#,
            r#"<reg name="r6" bitsize="32"/><reg name="r7" bitsize="32"/>"#,
            r#"<reg name="r8" bitsize="32"/><reg name="r9" bitsize="32"/>"#,
            r#"<reg name="r10" bitsize="32"/><reg name="r11" bitsize="32"/>"#,
            r#"<reg name="r12" bitsize="32"/><reg name="sp" bitsize="32" type="data_ptr"/>"#,
            r#"<reg name="lr" bitsize="32"/><reg name="pc" bitsize="32" type="code_ptr"/>"#,
            r#"<reg name="xpsr" bitsize="32"/></feature></target>"#,
        ))
    }
}

impl Registers for CoreRegisters {
    type ProgramCounter = u32;

    fn pc(&self) -> u32 {
        self.0[15]
    }

    fn gdb_serialize(&self, mut write_byte: impl FnMut(Option<u8>)) {
        self.0.iter().flat_map(|word| word.to_le_bytes()).for_each(|byte| write_byte(Some(byte)));
    }

    fn gdb_deserialize(&mut self, bytes: &[u8]) -> Result<(), ()> {
        if bytes.len() != 4 * self.0.len() {
            return Err(());
        }
        for (word, bytes) in self.0.iter_mut().zip(bytes.chunks_exact(4)) {
            *word = u32::from_le_bytes(bytes.try_into().map_err(|_| ())?);
        }
        Ok(())
    }
}

impl Target for Machine {
    type Arch = CortexM;
    type Error = Infallible;

    fn base_ops(&mut self) -> BaseOps<'_, CortexM, Infallible> {
        BaseOps::SingleThread(self)
    }

    fn support_breakpoints(&mut self) -> Option<BreakpointsOps<'_, Self>> {
        Some(self)
    }

    fn support_monitor_cmd(&mut self) -> Option<MonitorCmdOps<'_, Self>> {
        Some(self)
    }
}

impl SingleThreadBase for Machine {
    fn read_registers(&mut self, registers: &mut CoreRegisters) -> TargetResult<(), Self> {
        registers.0 = self.core_registers();
        Ok(())
    }

    fn write_registers(&mut self, registers: &CoreRegisters) -> TargetResult<(), Self> {
        let before = self.core_registers();
        for (number, (&new, old)) in registers.0.iter().zip(before).enumerate() {
            if new != old {
                self.set_core_register(number, new);
            }
        }
        Ok(())
    }

    /// Memory as far as it reaches from `start`, or registers word by word.
    fn read_addrs(&mut self, start: u32, data: &mut [u8]) -> TargetResult<usize, Self> {
        if self.denies_debugger(start) {
            return Ok(0);
        }
        if self.read_memory(start, data).is_ok() {
            return Ok(data.len());
        }
        let mut read = 0;
        for byte in data.iter_mut() {
            let address = start.wrapping_add(read as u32);
            let mut one = [0];
            if self.read_memory(address, &mut one).is_err() {
                break;
            }
            *byte = one[0];
            read += 1;
        }
        // The side effect of a load on a register must happen once for each word.
        let mut word = None;
        for (n, byte) in data.iter_mut().enumerate().skip(read) {
            let address = start.wrapping_add(n as u32);
            if word.is_none() || address.is_multiple_of(4) {
                word = self.register(address & !3);
            }
            let Some(value) = word else { break };
            *byte = value.to_le_bytes()[(address % 4) as usize];
            read += 1;
        }
        if read == 0 {
            return Err(TargetError::NonFatal);
        }
        Ok(read)
    }

    fn write_addrs(&mut self, start: u32, data: &[u8]) -> TargetResult<(), Self> {
        self.poke(start, data).map_err(|_| TargetError::NonFatal)
    }

    fn support_resume(&mut self) -> Option<SingleThreadResumeOps<'_, Self>> {
        Some(self)
    }
}

impl SingleThreadResume for Machine {
    fn resume(&mut self, _signal: Option<Signal>) -> Result<(), Infallible> {
        Machine::resume(self, false);
        Ok(())
    }

    fn support_single_step(&mut self) -> Option<SingleThreadSingleStepOps<'_, Self>> {
        Some(self)
    }
}

impl SingleThreadSingleStep for Machine {
    fn step(&mut self, _signal: Option<Signal>) -> Result<(), Infallible> {
        Machine::resume(self, true);
        Ok(())
    }
}

impl Breakpoints for Machine {
    fn support_sw_breakpoint(&mut self) -> Option<SwBreakpointOps<'_, Self>> {
        Some(self)
    }

    fn support_hw_breakpoint(&mut self) -> Option<HwBreakpointOps<'_, Self>> {
        Some(self)
    }
}

// Both kinds are the same here: no breakpoint is written into memory.

impl SwBreakpoint for Machine {
    fn add_sw_breakpoint(&mut self, address: u32, _kind: usize) -> TargetResult<bool, Self> {
        self.set_breakpoint(address, true);
        Ok(true)
    }

    fn remove_sw_breakpoint(&mut self, address: u32, _kind: usize) -> TargetResult<bool, Self> {
        self.set_breakpoint(address, false);
        Ok(true)
    }
}

impl HwBreakpoint for Machine {
    fn add_hw_breakpoint(&mut self, address: u32, kind: usize) -> TargetResult<bool, Self> {
        self.add_sw_breakpoint(address, kind)
    }

    fn remove_hw_breakpoint(&mut self, address: u32, kind: usize) -> TargetResult<bool, Self> {
        self.remove_sw_breakpoint(address, kind)
    }
}

impl MonitorCmd for Machine {
    fn handle_monitor_cmd(&mut self, command: &[u8], mut out: ConsoleOutput<'_>) -> Result<(), Infallible> {
        match command.trim_ascii() {
            b"reset" | b"reset halt" => {
                self.reset_pin();
                outputln!(out, "reset by the pin NRST; halted at {:08X}h", self.pc());
            }
            _ => outputln!(out, "known command: reset"),
        }
        Ok(())
    }
}

/// What goes to the debugger.
struct Line {
    stream: TcpStream,
    waiting: Vec<u8>,
}

impl Connection for Line {
    type Error = io::Error;

    fn write(&mut self, byte: u8) -> io::Result<()> {
        self.waiting.push(byte);
        Ok(())
    }

    fn flush(&mut self) -> io::Result<()> {
        let waiting = std::mem::take(&mut self.waiting);
        Write::write_all(&mut self.stream, &waiting)
    }
}

enum Event {
    Connected { stream: TcpStream, peer: SocketAddr },
    Bytes(Vec<u8>),
    Gone,
}

type Session = GdbStubStateMachine<'static, Machine, Line>;

/// The server for gdb. Its thread only carries bytes; the owner of the machine calls
/// [`exchange`](Self::exchange).
pub struct Door {
    address: SocketAddr,
    events: Receiver<Event>,
    session: Option<(Session, TcpStream)>,
    notices: Vec<String>,
}

impl Door {
    /// Listens for debuggers. The calling thread is unparked when there is something to exchange.
    ///
    /// # Errors
    /// The operating system's error, for instance that the address is in use.
    pub fn bind(address: impl ToSocketAddrs) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        let (sender, events) = sync_channel(EVENTS);
        let owner = thread::current();
        thread::Builder::new().name("gdb".into()).spawn(move || serve(&listener, &sender, &owner))?;
        Ok(Self { address, events, session: None, notices: Vec::new() })
    }

    /// The address at which it listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The events since the last call, as sentences for people to read.
    pub fn notices(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notices)
    }

    /// Passes data between debugger and machine in both directions; does not wait.
    pub fn exchange(&mut self, machine: &mut Machine) {
        self.report_halt(machine);
        while let Ok(event) = self.events.try_recv() {
            match event {
                Event::Connected { stream, peer } => self.open(machine, stream, peer),
                Event::Bytes(bytes) => bytes.into_iter().for_each(|byte| self.take(machine, byte)),
                Event::Gone => self.close(machine, "the debugger has gone"),
            }
            self.report_halt(machine);
        }
    }

    fn open(&mut self, machine: &mut Machine, stream: TcpStream, peer: SocketAddr) {
        if !machine.attach_debugger() {
            let why = "read-out protection of level 2 has switched the debug port off";
            self.notices.push(format!("a debugger from {peer} could not be served: {why}"));
            return;
        }
        let line = stream.try_clone().map(|stream| Line { stream, waiting: Vec::new() });
        let session = line.map_err(|error| error.to_string()).and_then(|line| {
            GdbStub::new(line).run_state_machine(machine).map_err(|error| error.to_string())
        });
        match session {
            Ok(session) => {
                self.session = Some((session, stream));
                self.notices.push(format!("a debugger has connected from {peer}: time stands still"));
            }
            Err(error) => {
                machine.detach_debugger();
                self.notices.push(format!("a debugger from {peer} could not be served: {error}"));
            }
        }
    }

    /// Ends the session, if there is one: the machine goes on.
    fn close(&mut self, machine: &mut Machine, why: &str) {
        if let Some((_, stream)) = self.session.take() {
            machine.detach_debugger();
            // The debugger may have closed the connection itself.
            let _ = stream.shutdown(Shutdown::Both);
            self.notices.push(format!("{why}: the board goes on"));
        }
    }

    fn take(&mut self, machine: &mut Machine, byte: u8) {
        let Some((session, stream)) = self.session.take() else { return };
        let next = match session {
            GdbStubStateMachine::Idle(session) => session.incoming_data(machine, byte),
            GdbStubStateMachine::Running(session) => session.incoming_data(machine, byte),
            other => Ok(other),
        };
        self.go_on(machine, next.map_err(|error| error.to_string()), stream);
    }

    /// Reports to the debugger that the machine, which it let run, is halted.
    fn report_halt(&mut self, machine: &mut Machine) {
        let Some((session, stream)) = self.session.take() else { return };
        let next = match (session, machine.halted()) {
            (GdbStubStateMachine::Running(session), Some(halt)) => {
                let signal = match halt {
                    Halt::Asked => Signal::SIGINT,
                    Halt::Breakpoint | Halt::Stepped => Signal::SIGTRAP,
                    Halt::Lockup => Signal::SIGSEGV,
                };
                session.report_stop(machine, SingleThreadStopReason::Signal(signal))
            }
            (session, _) => Ok(session),
        };
        self.go_on(machine, next.map_err(|error| error.to_string()), stream);
    }

    fn go_on(&mut self, machine: &mut Machine, next: Result<Session, String>, stream: TcpStream) {
        let next = next.and_then(|session| match session {
            GdbStubStateMachine::CtrlCInterrupt(session) => {
                machine.halt();
                let asked = SingleThreadStopReason::Signal(Signal::SIGINT);
                session.interrupt_handled(machine, Some(asked)).map_err(|error| error.to_string())
            }
            session => Ok(session),
        });
        match next {
            Ok(session) => {
                let left = matches!(session, GdbStubStateMachine::Disconnected(_));
                self.session = Some((session, stream));
                if left {
                    self.close(machine, "the debugger has left");
                }
            }
            Err(error) => {
                machine.detach_debugger();
                let _ = stream.shutdown(Shutdown::Both);
                self.notices.push(format!("the debugger is disconnected: {error}; the board goes on"));
            }
        }
    }
}

/// Serves one debugger after the other.
fn serve(listener: &TcpListener, events: &SyncSender<Event>, owner: &Thread) {
    let send = |event| {
        let is_sent = events.send(event).is_ok();
        owner.unpark();
        is_sent
    };
    loop {
        let Ok((stream, peer)) = listener.accept() else {
            // Perhaps the process is out of file descriptors: it goes on when a client leaves.
            thread::sleep(Duration::from_millis(50));
            continue;
        };
        let _ = stream.set_nodelay(true);
        let _ = stream.set_write_timeout(Some(PATIENCE));
        let Ok(mut reading) = stream.try_clone() else { continue };
        if !send(Event::Connected { stream, peer }) {
            return;
        }
        let mut buffer = [0; 1024];
        while let Ok(len @ 1..) = reading.read(&mut buffer) {
            if !send(Event::Bytes(buffer[..len].to_vec())) {
                return;
            }
        }
        if !send(Event::Gone) {
            return;
        }
    }
}

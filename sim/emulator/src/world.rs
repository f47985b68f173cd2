//! Machines and host ports on one bus, in one virtual time.
//!
//! The rule that makes it deterministic: the bus decides about a point of time when every machine
//! has reached it. A machine stops where it requests something of the bus, and waits until the bus
//! has answered. Meanwhile the others may be ahead of it by less than the shortest time in which
//! the bus can affect them.

use std::collections::VecDeque;

use crate::bus::fault::Fault;
use crate::bus::node::BusNode;
use crate::bus::port::{HostPort, Unplugged};
use crate::bus::{Bus, Record, SHORTEST_CONSEQUENCE_BITS};
use crate::bxcan::BxCan;
use crate::frame::Frame;
use crate::machine::{Machine, Stop};
use crate::time::{Span, Time};

/// Something with a CPU and a CAN controller that runs in virtual time. [`Machine`] is the real
/// one; tests of the world have simpler ones.
pub trait Computer {
    /// Why it stopped.
    type Stop;

    /// Whether it has power. Without, it is not on the bus and does not run.
    fn is_powered(&self) -> bool;

    /// The time that it has reached.
    fn now(&self) -> Time;

    /// Runs until `deadline` or a little further. Stops earlier only if its CAN controller wants
    /// attention, or to report an event.
    fn run_until(&mut self, deadline: Time) -> Self::Stop;

    /// Whether a debugger has halted it, and all time with it.
    fn is_halted(&self) -> bool {
        false
    }

    /// Its CAN controller.
    fn can(&mut self) -> &mut BxCan;

    /// Whether the stop is reported to the world's user (a reset, a lock-up) or is part of normal
    /// running.
    fn is_news(stop: &Self::Stop) -> bool;
}

/// A machine of the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct MachineId(usize);

/// A host port of the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct PortId(usize);

impl MachineId {
    /// Its place on the bus, as in [`Record::from`].
    #[must_use]
    pub fn node(self) -> usize {
        self.0
    }
}

impl PortId {
    /// Its place on the bus, as in [`Record::from`].
    #[must_use]
    pub fn node(self) -> usize {
        self.0
    }
}

/// An event of a machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct News<Stop> {
    /// The machine.
    pub machine: MachineId,
    /// The time.
    pub at: Time,
    /// The event.
    pub stop: Stop,
}

enum Plug<M> {
    Machine(Box<M>),
    Port(HostPort),
}

struct Slot<M> {
    plug: Plug<M>,
    /// What the bus sees while a machine has no power.
    unplugged: Unplugged,
    /// The number of runs in a row in which a machine made no progress.
    stuck: u32,
}

/// A machine that runs so often without progress is left behind.
const STUCK: u32 = 10_000;
/// The most events that wait to be fetched.
const MAX_NEWS: usize = 4096;
/// The bit time that bounds how far machines may be apart while nobody is on the bus: 1 Mbit/s, the
/// fastest there is.
const FASTEST_BIT: Span = Span::from_micros(1);

/// The bench: a bus and all nodes on it.
pub struct World<M: Computer = Machine> {
    bus: Bus,
    slots: Vec<Slot<M>>,
    now: Time,
    news: VecDeque<News<M::Stop>>,
    /// When something takes hold of the line of the bus.
    falls_at: Option<Time>,
}

impl<M: Computer> Default for World<M> {
    fn default() -> Self {
        Self { bus: Bus::new(), slots: Vec::new(), now: Time(0), news: VecDeque::new(), falls_at: None }
    }
}

fn nodes<M: Computer>(slots: &mut [Slot<M>]) -> Vec<&mut dyn BusNode> {
    slots.iter_mut().map(Slot::node).collect()
}

impl<M: Computer> Slot<M> {
    fn node(&mut self) -> &mut dyn BusNode {
        match &mut self.plug {
            Plug::Machine(machine) if machine.is_powered() => machine.can(),
            Plug::Machine(_) => &mut self.unplugged,
            Plug::Port(port) => port,
        }
    }

    fn running(&self) -> Option<&M> {
        match &self.plug {
            Plug::Machine(machine) if machine.is_powered() && self.stuck < STUCK => Some(machine),
            _ => None,
        }
    }
}

impl Computer for Machine {
    type Stop = Stop;

    fn is_powered(&self) -> bool {
        self.is_powered()
    }

    fn now(&self) -> Time {
        self.now()
    }

    fn run_until(&mut self, deadline: Time) -> Stop {
        self.run_until(deadline)
    }

    fn is_halted(&self) -> bool {
        self.halted().is_some()
    }

    fn can(&mut self) -> &mut BxCan {
        self.wired_can_mut()
    }

    fn is_news(stop: &Stop) -> bool {
        !matches!(stop, Stop::Deadline | Stop::Attention | Stop::Halted)
    }
}

impl World<Machine> {
    /// A bench with a bus and nothing on it.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Switches the machine's power on, now. Without effect if it is on.
    pub fn power_on(&mut self, id: MachineId) {
        let now = self.now;
        if !self.machine(id).is_powered() {
            self.machine_mut(id).power_on(now);
        }
    }

    /// Switches the machine's power off, now. A frame that it is sending breaks off.
    pub fn power_off(&mut self, id: MachineId) {
        self.machine_mut(id).power_off();
    }
}

impl<M: Computer> World<M> {
    /// The time up to which everything has happened.
    #[must_use]
    pub fn now(&self) -> Time {
        self.now
    }

    /// The bus, for its totals.
    #[must_use]
    pub fn bus(&self) -> &Bus {
        &self.bus
    }

    /// Gives every frame to `sink` when it is over.
    pub fn add_sink(&mut self, sink: impl FnMut(&Record) + 'static) {
        self.bus.add_sink(sink);
    }

    /// Injects a fault on the bus from now on. Returns a number for [`Bus::fault_hits`].
    pub fn inject(&mut self, fault: Fault) -> usize {
        self.bus.inject(fault)
    }

    /// Removes all faults.
    pub fn clear_faults(&mut self) {
        self.bus.clear_faults();
    }

    /// From now on something holds the line of the bus dominant, or lets it go.
    pub fn hold_dominant(&mut self, is_held: bool) {
        let mut nodes = nodes(&mut self.slots);
        self.bus.advance(self.now, &mut nodes);
        self.bus.hold_dominant(is_held, &mut nodes);
    }

    /// The same after a time, while the world runs.
    pub fn hold_dominant_after(&mut self, span: Span) {
        self.falls_at = Some(self.now + span);
    }

    fn plug(&mut self, plug: Plug<M>) -> usize {
        self.slots.push(Slot { plug, unplugged: Unplugged, stuck: 0 });
        self.slots.len() - 1
    }

    /// Plugs a machine in. It takes part as soon as it has power.
    pub fn add_machine(&mut self, machine: M) -> MachineId {
        MachineId(self.plug(Plug::Machine(Box::new(machine))))
    }

    /// Plugs in a port for the host, at this bit rate in bit/s.
    pub fn add_host_port(&mut self, bit_rate: u32) -> PortId {
        PortId(self.plug(Plug::Port(HostPort::new(bit_rate))))
    }

    /// The machine.
    ///
    /// # Panics
    /// If the id comes from another world.
    pub fn machine_mut(&mut self, id: MachineId) -> &mut M {
        match &mut self.slots[id.0].plug {
            Plug::Machine(machine) => machine,
            Plug::Port(_) => panic!("the machine id is one of another world"),
        }
    }

    /// The machine.
    ///
    /// # Panics
    /// If the id comes from another world.
    #[must_use]
    pub fn machine(&self, id: MachineId) -> &M {
        match &self.slots[id.0].plug {
            Plug::Machine(machine) => machine,
            Plug::Port(_) => panic!("the machine id is one of another world"),
        }
    }

    /// The port.
    ///
    /// # Panics
    /// If the id comes from another world.
    pub fn port_mut(&mut self, id: PortId) -> &mut HostPort {
        match &mut self.slots[id.0].plug {
            Plug::Port(port) => port,
            Plug::Machine(_) => panic!("the port id is one of another world"),
        }
    }

    /// Sends a frame from the port as soon as the bus lets it. Gives a ticket, see
    /// [`HostPort::sent`].
    pub fn send(&mut self, port: PortId, frame: Frame) -> u64 {
        let now = self.now;
        self.port_mut(port).send(frame, now)
    }

    /// The oldest frame that the port has received and nobody has fetched, and when it was
    /// complete.
    pub fn receive(&mut self, port: PortId) -> Option<(Time, Frame)> {
        self.port_mut(port).receive()
    }

    /// The oldest event of a machine that was not fetched yet.
    pub fn news(&mut self) -> Option<News<M::Stop>> {
        self.news.pop_front()
    }

    /// Whether a debugger has halted a machine. Time is stopped then, for all.
    #[must_use]
    pub fn is_halted(&self) -> bool {
        self.slots.iter().any(|slot| matches!(&slot.plug, Plug::Machine(machine) if machine.is_halted()))
    }

    /// Processes everything up to and including `time`, or until a debugger halts a machine.
    pub fn run_until(&mut self, time: Time) {
        while self.now < time && !self.is_halted() {
            self.step(time);
        }
    }

    /// Lets `span` pass.
    pub fn run_for(&mut self, span: Span) {
        self.run_until(self.now + span);
    }

    /// Runs until the port has a frame, at most until `deadline`; fetches the frame. A frame that
    /// is waiting already comes at once.
    pub fn run_until_frame_or(&mut self, port: PortId, deadline: Time) -> Option<(Time, Frame)> {
        loop {
            if let Some(received) = self.receive(port) {
                return Some(received);
            }
            if self.now >= deadline || self.is_halted() {
                return None;
            }
            self.step(deadline);
        }
    }

    /// Runs the machines to the next point at which the bus has something to decide, `limit` at the
    /// latest, and lets it decide.
    fn step(&mut self, limit: Time) {
        // A machine that has just got power is not known to the bus yet; without the bus it would
        // not stop for it.
        self.bus.advance(self.now, &mut nodes(&mut self.slots));
        if self.falls_at.is_some_and(|at| at <= self.now) {
            self.falls_at = None;
            self.bus.hold_dominant(true, &mut nodes(&mut self.slots));
        }
        let limit = self.falls_at.map_or(limit, |at| at.min(limit));
        let horizon = {
            let nodes = nodes(&mut self.slots);
            self.bus.next_event(&nodes).map_or(limit, |event| event.min(limit))
        };
        let lead = self.lead();
        for n in 0..self.slots.len() {
            let until = match self.slowest_but(n) {
                Some(others) => horizon.min(others + lead),
                None => horizon,
            };
            self.run_machine(n, until);
        }
        let reached = self.slowest_but(usize::MAX).map_or(horizon, |slowest| slowest.min(horizon));
        let mut nodes = nodes(&mut self.slots);
        self.bus.advance(reached, &mut nodes);
        self.now = self.now.max(reached);
    }

    /// How far machines may be apart.
    fn lead(&mut self) -> Span {
        let nodes = nodes(&mut self.slots);
        let bits = nodes.iter().filter_map(|node| node.line()).map(|line| line.bit);
        let bit = bits.min().unwrap_or(FASTEST_BIT).min(FASTEST_BIT);
        Span(bit.0 * SHORTEST_CONSEQUENCE_BITS)
    }

    /// How far the slowest running machine has come, not counting the one in slot `n`.
    fn slowest_but(&self, n: usize) -> Option<Time> {
        let others = self.slots.iter().enumerate().filter(|(other, _)| *other != n);
        others.filter_map(|(_, slot)| slot.running()).map(Computer::now).min()
    }

    fn run_machine(&mut self, n: usize, until: Time) {
        let slot = &mut self.slots[n];
        let stuck = &mut slot.stuck;
        let Plug::Machine(machine) = &mut slot.plug else { return };
        if !machine.is_powered() {
            *stuck = 0;
            return;
        }
        let before = machine.now();
        if *stuck >= STUCK || before >= until || machine.can().wants_attention() {
            return;
        }
        let stop = machine.run_until(until);
        *stuck = if machine.now() > before || machine.can().wants_attention() { 0 } else { *stuck + 1 };
        if M::is_news(&stop) {
            if self.news.len() == MAX_NEWS {
                self.news.pop_front();
            }
            self.news.push_back(News { machine: MachineId(n), at: machine.now(), stop });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::Outcome;
    use crate::peripheral::Peripheral;
    use std::cell::RefCell;
    use std::rc::Rc;

    /// A machine with a program of a few lines: it joins the bus at 1 Mbit/s, sends a frame every
    /// `period`, answers every frame that it gets with one of its own, and takes a while for each
    /// step. It remembers what its registers said and when.
    struct Scripted {
        can: BxCan,
        now: Time,
        powered: bool,
        id: u16,
        period: Span,
        next_send: Time,
        step: Span,
        seen: Vec<(Time, u32)>,
        stuck: bool,
    }

    impl Scripted {
        fn new(id: u16, period: Span, step: Span) -> Self {
            let mut can = BxCan::new();
            // TXFP.
            can.set_up(4, 0);
            let (now, next_send, seen) = (Time(0), Time(0) + period, Vec::new());
            Self { can, now, powered: true, id, period, next_send, step, seen, stuck: false }
        }

        fn transmit(&mut self, id: u16) {
            let tsr = self.can.read(0x08, self.now).unwrap();
            let mailbox = tsr >> 24 & 3;
            if tsr >> (26 + mailbox) & 1 == 1 {
                self.can.write(0x184 + 0x10 * mailbox, 0, self.now).unwrap();
                self.can.write(0x180 + 0x10 * mailbox, u32::from(id) << 21 | 1, self.now).unwrap();
            }
        }
    }

    impl Computer for Scripted {
        type Stop = ();
        fn is_powered(&self) -> bool {
            self.powered
        }
        fn now(&self) -> Time {
            self.now
        }
        fn run_until(&mut self, deadline: Time) {
            assert!(!self.can.wants_attention(), "it must wait for the bus first");
            let mut attention = false;
            while !self.stuck && self.now < deadline && !attention {
                self.now = self.now + self.step;
                if self.can.read(0x0C, self.now).unwrap() & 3 > 0 {
                    let id = self.can.read(0x1B0, self.now).unwrap() >> 21;
                    self.seen.push((self.now, id));
                    self.can.write(0x0C, 0x20, self.now).unwrap();
                    if id < 0x400 {
                        self.transmit(0x400 + self.id);
                    }
                } else if self.now >= self.next_send {
                    self.next_send = self.next_send + self.period;
                    self.transmit(self.id);
                }
                attention = self.can.wants_attention();
            }
        }
        fn can(&mut self) -> &mut BxCan {
            &mut self.can
        }
        fn is_news(_stop: &()) -> bool {
            false
        }
    }

    type Trace = Rc<RefCell<Vec<Record>>>;

    fn traced() -> (World<Scripted>, Trace) {
        let mut world = World::default();
        let trace = Trace::default();
        let sink = trace.clone();
        world.add_sink(move |record| sink.borrow_mut().push(*record));
        (world, trace)
    }

    #[test]
    fn a_machine_answers_a_port() {
        let (mut world, _) = traced();
        let machine = world.add_machine(Scripted::new(0x10, Span::from_millis(1_000), Span::from_nanos(100)));
        let port = world.add_host_port(1_000_000);
        world.run_until(Time(1_000_000_000));
        world.send(port, Frame::standard(0x080, &[]).unwrap());
        let (at, answer) = world.run_until_frame_or(port, Time(2_000_000_000)).unwrap();
        assert_eq!(answer.raw_id(), 0x410);
        // Sent at 1000 us, 48 bits, received at 1047 us and answered within a step; the bus is free
        // at 1051 us, and 410# (47 bits: 0 10000 (1) 010000 ... see the frame's own length) is
        // valid one bit before its end.
        let len = u64::from(answer.wire_len());
        assert_eq!(at, Time((1051 + len - 1) * 1_000_000));
        assert_eq!(world.now(), at);
        let (seen, id) = world.machine(machine).seen[0];
        assert_eq!(id, 0x080);
        assert!((Time(1_047_000_000)..=Time(1_047_200_000)).contains(&seen), "{seen}");
        assert_eq!(world.run_until_frame_or(port, Time(3_000_000_000)), None);
        assert_eq!(world.now(), Time(3_000_000_000));
    }

    /// Three machines of different speed and a port, all talking.
    fn crowd(chunk: Span) -> (Vec<Record>, Vec<Vec<(Time, u32)>>) {
        let (mut world, trace) = traced();
        let ids: Vec<_> = [(0x10, 700, 130), (0x20, 900, 410), (0x30, 1_100, 3_000)]
            .into_iter()
            .map(|(id, micros, step)| {
                world.add_machine(Scripted::new(id, Span::from_micros(micros), Span::from_nanos(step)))
            })
            .collect();
        let port = world.add_host_port(1_000_000);
        for n in 1..=50 {
            world
                .port_mut(port)
                .send(Frame::standard(0x300 + n, &[]).unwrap(), Time(u64::from(n) * 777_000_000));
        }
        while world.now() < Time(50_000_000_000) {
            world.run_until((world.now() + chunk).min(Time(50_000_000_000)));
        }
        let seen = ids.into_iter().map(|id| world.machine(id).seen.clone()).collect();
        let records = trace.borrow().clone();
        (records, seen)
    }

    #[test]
    fn the_same_input_gives_the_same_trace() {
        let once = crowd(Span::from_millis(50));
        assert!(once.0.len() > 300, "{}", once.0.len());
        let bad: Vec<_> = once.0.iter().filter(|record| record.outcome != Outcome::Good).collect();
        assert!(bad.is_empty(), "{bad:?}");
        assert_eq!(once, crowd(Span::from_millis(50)));
        // The size of the steps in which the caller goes on does not matter either.
        assert_eq!(once.0, crowd(Span::from_micros(333)).0);
    }

    #[test]
    fn nobody_sees_a_frame_before_it_is_over() {
        let (records, seen) = crowd(Span::from_millis(50));
        for (at, id) in seen.iter().flatten() {
            let bit = Span::from_micros(1);
            let over = records.iter().any(|record| record.frame.raw_id() == *id && record.end <= *at + bit);
            assert!(over, "{id:x} at {at}");
        }
        // Frames follow one another with at least the intermission between them.
        for pair in records.windows(2) {
            assert!(pair[1].start >= pair[0].end + Span::from_micros(3), "{pair:?}");
        }
    }

    #[test]
    fn power_decides_who_takes_part() {
        let (mut world, trace) = traced();
        let machine = world.add_machine(Scripted::new(0x10, Span::from_millis(1), Span::from_nanos(500)));
        let port = world.add_host_port(1_000_000);
        world.machine_mut(machine).powered = false;
        world.send(port, Frame::standard(0x080, &[]).unwrap());
        world.run_until(Time(10_000_000_000));
        assert!(trace.borrow().iter().all(|record| record.outcome != Outcome::Good), "nobody acknowledges");
        world.machine_mut(machine).powered = true;
        world.machine_mut(machine).now = world.now();
        world.machine_mut(machine).next_send = world.now() + Span::from_millis(1);
        world.run_until(Time(20_000_000_000));
        assert_eq!(world.port_mut(port).waiting(), 0);
        assert!(world.receive(port).is_some());
    }

    #[test]
    fn a_machine_that_hangs_does_not_hang_the_world() {
        let (mut world, _) = traced();
        let machine = world.add_machine(Scripted::new(0x10, Span::from_millis(1), Span::from_nanos(500)));
        world.machine_mut(machine).stuck = true;
        world.run_until(Time(5_000_000_000));
        assert_eq!(world.now(), Time(5_000_000_000));
    }
}

//! A host that stops anywhere in a block download, as a busy PC does: 0 to 300 ms before any frame that it
//! sends or reads, while the frames of the bus take their time. Two kinds of clients are in the field: those
//! that read what has arrived before each segment, as ours does, and those that read nothing before they have
//! sent the whole sub-block (python-canopen, Zephyr). Both repeat what was not acknowledged.

use std::collections::VecDeque;

use canopen::sdo::client::{Config as ClientConfig, Download, Step, Transfer};
use canopen::sdo::server::Config;
use canopen::{Address, BitRate, Frame};
use kit::bus::{at, node, request, Bench};
use kit::crc::crc16;
use kit::random::Random;

/// The most bits of a frame with eight bytes, with stuff bits and the intermission (ISO 11898-1).
const FRAME_BITS: u64 = 135;

/// Each client of the field waits at least this long for an answer (python-canopen).
const TIMEOUT_US: u64 = 300_000;

/// The bus between a host that stops at times and the server, in microseconds.
struct Wire {
    bench: Bench,
    frame_us: u64,
    now: u64,
    /// What arrived at the host and was not read, with the time.
    arrived: VecDeque<(u64, Frame)>,
    random: Random,
    /// How often in 1 000 steps the host stops.
    per_mille: usize,
    /// Acknowledgements of less than what was granted.
    early: usize,
    granted: u8,
}

impl Wire {
    fn new(bit_rate: BitRate, seed: u64) -> Self {
        let mut random = Random(seed);
        let per_mille = random.pick(&[2, 10, 50]);
        let bits = u64::from(bit_rate.bits_per_second().expect("a rate"));
        Self {
            bench: Bench::with(Config { bit_rate, ..Config::DEFAULT }),
            frame_us: FRAME_BITS * 1_000_000 / bits,
            now: 0,
            arrived: VecDeque::new(),
            random,
            per_mille,
            early: 0,
            granted: 0,
        }
    }

    /// Time passes; the server, which never stops, sends what is due.
    fn pass(&mut self, us: u64) {
        let until = self.now + us;
        loop {
            self.bench.now = (self.now / 1000) as u32;
            for frame in self.bench.sent() {
                if let Some([0xA2, ackseq, blksize, ..]) = frame.exactly::<8>() {
                    self.early += usize::from(*ackseq < self.granted);
                    self.granted = *blksize;
                } else if let Some([0xA4, _, _, _, blksize, ..]) = frame.exactly::<8>() {
                    self.granted = *blksize;
                }
                self.arrived.push_back((self.now + self.frame_us, frame));
            }
            if self.now == until {
                return;
            }
            self.now = until.min((self.now / 1000 + 1) * 1000);
        }
    }

    /// The host may stop here.
    fn stall(&mut self) {
        if self.random.below(1000) < self.per_mille {
            let us = self.random.below(300_001) as u64;
            self.pass(us);
        }
    }

    fn send(&mut self, frame: &Frame) {
        self.stall();
        self.pass(self.frame_us);
        let Bench { server, device, now, .. } = &mut self.bench;
        server.handle(frame, at(*now), device);
        self.pass(0);
    }

    /// The oldest frame that has arrived.
    fn read(&mut self) -> Option<Frame> {
        self.stall();
        let is_here = self.arrived.front().is_some_and(|(when, _)| *when <= self.now);
        is_here.then(|| self.arrived.pop_front().map(|(_, frame)| frame)).flatten()
    }

    /// The next frame, within the client's time-out.
    fn wait(&mut self) -> Option<[u8; 8]> {
        let until = self.now + TIMEOUT_US;
        loop {
            if let Some(frame) = self.read() {
                return frame.exactly::<8>().copied();
            }
            if self.now >= until {
                return None;
            }
            self.pass(100);
        }
    }
}

/// A client that reads before each segment.
fn attentive(wire: &mut Wire, data: &[u8]) -> Result<(), String> {
    let config = ClientConfig { timeout_ms: (TIMEOUT_US / 1000) as u32 };
    let mut client = Download::as_blocks(node(), Address::new(0x1F50, 1), data, config);
    loop {
        while let Some(frame) = wire.read() {
            client.handle(&frame, at((wire.now / 1000) as u32));
        }
        match client.poll(at((wire.now / 1000) as u32)) {
            Step::Send(frame) => wire.send(&frame),
            Step::Wait(_) => wire.pass(100),
            Step::Done(result) => return result.map_err(|error| error.to_string()),
        }
    }
}

/// A client that reads only after the whole sub-block, written from CiA 301 sections 7.2.4.3.9 ff.
fn deaf(wire: &mut Wire, data: &[u8]) -> Result<(), String> {
    let size = (data.len() as u32).to_le_bytes();
    wire.send(&request([0xC6, 0x50, 0x1F, 1, size[0], size[1], size[2], size[3]]));
    let Some([0xA4, 0x50, 0x1F, 1, mut blksize, ..]) = wire.wait() else { return Err("initiate".into()) };
    let mut done = 0;
    while done < data.len() {
        let parts: Vec<&[u8]> = data[done..].chunks(7).take(usize::from(blksize)).collect();
        let mut end = done;
        for (part, seqno) in parts.iter().zip(1..) {
            end += part.len();
            let mut bytes = [0; 8];
            bytes[0] = if end == data.len() { 0x80 | seqno } else { seqno };
            bytes[1..=part.len()].copy_from_slice(part);
            wire.send(&request(bytes));
        }
        match wire.wait() {
            Some([0xA2, ackseq, next, ..]) if usize::from(ackseq) <= parts.len() => {
                done = data.len().min(done + 7 * usize::from(ackseq));
                blksize = next;
            }
            other => return Err(format!("{done} bytes: {other:02X?}")),
        }
    }
    let unused = (7 - data.len() % 7) % 7;
    let [low, high] = crc16(data).to_le_bytes();
    wire.send(&request([0xC1 | (unused as u8) << 2, low, high, 0, 0, 0, 0, 0]));
    match wire.wait() {
        Some([0xA1, ..]) => Ok(()),
        other => Err(format!("end: {other:02X?}")),
    }
}

type Client = fn(&mut Wire, &[u8]) -> Result<(), String>;

#[test]
fn a_host_that_stops_for_300_ms_anywhere_gets_its_block_through() {
    let clients: [(&str, Client); 2] = [("attentive", attentive), ("deaf", deaf)];
    for (name, client) in clients {
        for bit_rate in [BitRate::K125, BitRate::K1000] {
            let (mut early, mut aborted) = (0, 0);
            for seed in 0..1000 {
                let mut wire = Wire::new(bit_rate, seed);
                let size = 5 + wire.random.below(4096);
                let data: Vec<u8> = (0..size).map(|_| wire.random.next() as u8).collect();
                let mut outcome = client(&mut wire, &data);
                if outcome.is_err() {
                    aborted += 1;
                    while wire.wait().is_some() {}
                    outcome = client(&mut wire, &data);
                }
                assert_eq!(outcome, Ok(()), "{name} client, {bit_rate:?}, seed {seed}");
                assert_eq!(wire.bench.device.domain, data, "{name} client, {bit_rate:?}, seed {seed}");
                early += wire.early;
            }
            assert!(early > 100, "{name} client, {bit_rate:?}: {early} early acknowledgements");
            assert!(aborted <= 10, "{name} client, {bit_rate:?}: {aborted} of 1000 aborted");
        }
    }
}

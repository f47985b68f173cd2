//! The downloads of a group: one for the data that its conversations bring at the same time.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

use canopen::frame::Channel;
use canopen::sdo::client::{Config, GroupDownload, GroupResult, GroupStep, Servers, SERVERS_MAX};
use canopen::{AbortCode, Frame, Instant};

use super::line::{Item, Line, Options, Reply, State};
use crate::adapter::{Adapter, AdapterError, Delivery};

/// After this many frames in a row, the bus is read.
const BURST: usize = 8;
/// A device that makes the download break off this many times in a row gets the data alone.
const STRIKES: u8 = 2;

/// The downloads of a group. Servers have the numbers of their lines.
pub(super) struct GroupDownloads {
    timeout_ms: u32,
    cancelled: Arc<AtomicBool>,
    running: Option<Running>,
    /// For each line, how many downloads in a row were broken off because of it.
    strikes: Vec<u8>,
    /// There was a download, so the devices may send answers at any time.
    has_begun: bool,
    /// Somebody else uses a COB-ID of the group.
    is_disturbed: bool,
}

/// A running download.
struct Running {
    download: GroupDownload<Vec<u8>>,
    lines: Vec<usize>,
    refused: Vec<(usize, AbortCode)>,
    /// When it goes on without a frame.
    until: Duration,
}

impl GroupDownloads {
    pub(super) fn new(options: &Options) -> Self {
        Self {
            timeout_ms: u32::try_from(options.answer.as_millis()).unwrap_or(u32::MAX / 4),
            cancelled: options.cancelled.clone(),
            running: None,
            strikes: Vec::new(),
            has_begun: false,
            is_disturbed: false,
        }
    }

    /// The time until which the running download waits for a frame.
    pub(super) fn deadline(&self) -> Option<Duration> {
        self.running.as_ref().map(|running| running.until)
    }

    /// Begins a download if all conversations of the group wait for it, and sends what is due. The
    /// group `is_complete` when all its conversations have started.
    pub(super) fn go_on(
        &mut self,
        adapter: &mut dyn Adapter,
        lines: &mut [Option<Line>],
        is_complete: bool,
    ) -> Result<(), AdapterError> {
        self.strikes.resize(lines.len(), 0);
        if self.running.is_none() && is_complete {
            self.gather(lines, adapter.now());
        }
        let Some(running) = &mut self.running else { return Ok(()) };
        if self.is_disturbed || self.cancelled.load(Ordering::Relaxed) {
            running.download.abort();
        }
        for _ in 0..BURST {
            let now = adapter.now();
            match running.download.poll(instant(now)) {
                GroupStep::Send(frame) => adapter.send(&frame)?,
                GroupStep::Wait(until) => {
                    let left = if instant(now).has_reached(until) { 0 } else { until.since(instant(now)) };
                    running.until = now + Duration::from_millis(left.into());
                    return Ok(());
                }
                GroupStep::Done(result) => {
                    self.end(result, lines, now);
                    return Ok(());
                }
            }
        }
        running.until = adapter.now();
        Ok(())
    }

    /// Passes a frame to the running download, and notices those of somebody else.
    pub(super) fn hear(&mut self, frame: &Frame, lines: &[Option<Line>], now: Duration) {
        let parts = lines.iter().enumerate().filter_map(|(number, line)| {
            let channel: Channel = line.as_ref()?.channel?;
            Some((number, channel))
        });
        for (number, channel) in parts {
            let is_answer = frame.has_cob_id(channel.response);
            self.is_disturbed |= frame.has_cob_id(channel.request) || (is_answer && !self.has_begun);
            if let (true, Some(running), Some(bytes)) = (is_answer, &mut self.running, frame.exactly::<8>()) {
                if let Err(code) = running.download.handle(number, bytes, instant(now)) {
                    running.refused.push((number, code));
                }
            }
        }
    }

    /// Begins a download for the conversations with the lowest turn, once all have come.
    fn gather(&mut self, lines: &mut [Option<Line>], now: Duration) {
        let in_group = |line: &&Line| line.channel.is_some() && line.state != State::Gone;
        let members = || lines.iter().flatten().filter(in_group);
        let item = |line: &Line| match &line.state {
            State::InGroup(item) => Some(item.clone()),
            _ => None,
        };
        let Some(items) = members().map(item).collect::<Option<Vec<Item>>>() else { return };
        let Some(first) = items.into_iter().min_by_key(|item| item.turn) else { return };
        let is_with = |number: &usize| {
            let line = lines[*number].as_ref();
            line.is_some_and(|line| in_group(&line) && line.state == State::InGroup(first.clone()))
        };
        let with: Vec<usize> = (0..lines.len().min(SERVERS_MAX)).filter(is_with).collect();
        let channel = with.first().and_then(|number| lines[*number].as_ref()?.channel);
        let is_over = self.is_disturbed || self.cancelled.load(Ordering::Relaxed);
        let (Some(channel), false) = (channel, is_over || with.len() == 1) else {
            let met = if self.is_disturbed { Delivery::Disturbed } else { Delivery::Alone };
            with.iter().for_each(|number| wake(lines, *number, met, now));
            return;
        };
        let servers = with.iter().fold(0, |servers: Servers, number| servers | 1 << number);
        let config = Config { timeout_ms: self.timeout_ms };
        let download = GroupDownload::new(channel.request, servers, first.at, first.data, config);
        self.has_begun = true;
        self.running = Some(Running { download, lines: with, refused: Vec::new(), until: now });
    }

    /// Reports to the conversations what became of their data. After a download that was broken
    /// off, they wait for the next one, except for a device that breaks off each.
    fn end(&mut self, result: GroupResult, lines: &mut [Option<Line>], now: Duration) {
        let Some(running) = self.running.take() else { return };
        let devices = running.lines.len();
        for number in running.lines {
            let is_missing = result.missing & 1 << number != 0;
            let refused = running.refused.iter().find(|(line, _)| *line == number);
            let met = match (result.ended, is_missing) {
                (true, false) => Some(Delivery::Taken(devices)),
                (true, true) => {
                    Some(refused.map_or(Delivery::NoAnswer, |(_, code)| Delivery::Refused(*code)))
                }
                (false, true) => {
                    self.strikes[number] += 1;
                    (self.strikes[number] >= STRIKES).then_some(Delivery::Alone)
                }
                (false, false) => None,
            };
            if let Some(met) = met {
                self.strikes[number] = 0;
                wake(lines, number, met, now);
            }
        }
    }
}

fn wake(lines: &mut [Option<Line>], number: usize, met: Delivery, now: Duration) {
    if let Some(line) = &mut lines[number] {
        line.wake(Ok(Reply::Delivery(met)), now);
    }
}

/// The bus time in the form of the state machines, which compare times by difference.
fn instant(now: Duration) -> Instant {
    Instant::from_millis(now.as_millis() as u32)
}

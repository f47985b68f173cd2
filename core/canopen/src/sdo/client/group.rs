//! Writing one value to several servers at once.

use crate::abort::AbortCode;
use crate::frame::{CobId, Frame};
use crate::od::Address;
use crate::sdo::block::check_blksize;
use crate::sdo::client::download::SubBlock;
use crate::sdo::client::transfer::{concerns, Config};
use crate::sdo::wire::{BlockAck, Request, Response};
use crate::time::Instant;

/// A set of the servers of a group: bit n is server n.
pub type Servers = u128;

/// The most servers of a group.
pub const SERVERS_MAX: usize = Servers::BITS as usize;

/// How long the answers of single servers are awaited when others have answered the initiate or the
/// end, or have acknowledged the whole sub-block, in milliseconds: longer than a server waits for a
/// missing segment.
const LATE_MS: u32 = 120;

/// A block download to several servers that have the same COB-ID for requests and different ones
/// for answers (1201h).
///
/// A segment that all servers miss is sent again within the transfer, as in any block download. A
/// server that misses one alone stays behind: the others go on, and its CRC at the end does not
/// match. So each server takes the whole data or none, and the caller sends them again to those
/// that have none. They must be such that a server which has taken them takes them again.
///
/// No server ever gets more bytes than were announced: that would end its transfer, and it would
/// take the segments after that for requests.
#[derive(Debug)]
pub struct GroupDownload<D> {
    request: CobId,
    at: Address,
    data: D,
    timeout_ms: u32,
    servers: Servers,
    state: State,
    /// The time of the last sent frame, or of the last answer that was missing.
    moved: Instant,
}

#[derive(Debug)]
enum State {
    /// The initiate must be sent.
    Begin,
    /// Servers have not answered the initiate yet; with their block size, once it is known.
    Initiated {
        missing: Servers,
        crc: bool,
        blksize: Option<u8>,
    },
    /// A sub-block is being sent, or waits for its acknowledgements.
    Blocks(Sent),
    /// All data have arrived; the end must be sent.
    End {
        crc: u16,
    },
    /// Servers have not confirmed the end yet, or have refused it.
    Ended {
        missing: Servers,
        refused: Servers,
    },
    /// The abort must be sent.
    Break {
        result: GroupResult,
        code: AbortCode,
    },
    Done(GroupResult),
}

/// A sub-block and its acknowledgements so far.
#[derive(Clone, Copy, Debug)]
struct Sent {
    sub_block: SubBlock,
    /// The servers without an acknowledgement.
    missing: Servers,
    /// The first and the last acknowledged segment that a server has named.
    range: Option<(u8, u8)>,
    /// The size of the next sub-block.
    blksize: u8,
}

/// The end of a download.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GroupResult {
    /// The servers that have not taken the data. Before the end of the download, no server has;
    /// then these are the ones which caused that it was broken off.
    pub missing: Servers,
    /// Whether the end was sent: the servers that are not missing have taken the data.
    pub ended: bool,
}

/// The next action for a download.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GroupStep {
    /// Send this frame, and ask again.
    Send(Frame),
    /// Wait for frames, at most until this time.
    Wait(Instant),
    /// The download has ended. Every later call returns this, too.
    Done(GroupResult),
}

impl<D: AsRef<[u8]>> GroupDownload<D> {
    /// Writes `data` to `at` of these servers, of which there must be one at least. `request` is
    /// their common COB-ID. Nothing is sent before the first [`poll`](Self::poll).
    pub const fn new(request: CobId, servers: Servers, at: Address, data: D, config: Config) -> Self {
        Self {
            request,
            at,
            data,
            timeout_ms: config.timeout_ms,
            servers,
            state: State::Begin,
            moved: Instant::from_millis(0),
        }
    }

    /// Processes the data of a frame with the COB-ID for answers of server `number`. Frames that do
    /// not belong to this download are ignored.
    ///
    /// # Errors
    /// The abort of a server that refuses the data.
    pub fn handle(&mut self, number: usize, bytes: &[u8; 8], now: Instant) -> Result<(), AbortCode> {
        let server = 1 << (number % SERVERS_MAX) & self.servers;
        // One that is not addressed, for example late from an attempt before.
        if server == 0 {
            return Ok(());
        }
        let response = Response::parse(bytes);
        if let Some(Response::Abort(at, code)) = response {
            if !concerns(at, self.at) {
                return Ok(());
            }
            match &mut self.state {
                // Its transfer has ended, so it must get no more segments.
                State::Initiated { .. } | State::Blocks(_) | State::End { .. } => self.break_off(server),
                // The end of a download is each server's own.
                State::Ended { missing, refused } if *missing & server != 0 => {
                    *missing &= !server;
                    *refused |= server;
                    self.proceed();
                }
                _ => return Ok(()),
            }
            return Err(code);
        }
        let is_new = match (&mut self.state, response) {
            (
                State::Initiated { missing, crc, blksize },
                Some(Response::InitiateBlockDownload { at, crc: checks, blksize: granted }),
            ) if at == self.at => {
                // One server decides for all: the end carries one CRC, and a sub-block one size.
                if check_blksize(granted).is_err() || blksize.is_some_and(|other| other != granted) {
                    self.break_off(server);
                    return Ok(());
                }
                *blksize = Some(granted);
                *crc |= checks;
                take(missing, server)
            }
            (State::Blocks(sent), Some(Response::AckBlockDownload(ack))) => {
                if sent.missing & server == 0 || !sent.sub_block.has_sent(ack.ackseq) {
                    // The acknowledgement of the sub-block before, late.
                    return Ok(());
                }
                let fits = check_blksize(ack.blksize).is_ok();
                if !fits || (sent.range.is_some() && sent.blksize != ack.blksize) {
                    self.break_off(server);
                    return Ok(());
                }
                let (first, last) = sent.range.unwrap_or((ack.ackseq, ack.ackseq));
                sent.range = Some((first.min(ack.ackseq), last.max(ack.ackseq)));
                sent.blksize = ack.blksize;
                take(&mut sent.missing, server)
            }
            (State::Ended { missing, .. }, Some(Response::EndBlockDownload)) => take(missing, server),
            _ => false,
        };
        if is_new {
            self.moved = now;
            self.proceed();
        }
        Ok(())
    }

    /// Ends the download for all servers, unless it has ended.
    pub fn abort(&mut self) {
        if !matches!(self.state, State::Done(_)) {
            self.break_off(self.servers);
        }
    }

    fn break_off(&mut self, missing: Servers) {
        let result = GroupResult { missing, ended: false };
        self.state = State::Break { result, code: AbortCode::GENERAL };
    }

    /// Goes on if all servers have answered.
    fn proceed(&mut self) {
        match self.state {
            State::Initiated { missing: 0, crc, blksize: Some(blksize) } => {
                let sub_block = SubBlock::new(crc, blksize);
                self.state = State::Blocks(Sent { sub_block, missing: self.servers, range: None, blksize });
            }
            State::Blocks(sent) if sent.missing == 0 => self.next_sub_block(sent),
            State::Ended { missing: 0, refused: 0 } => {
                self.state = State::Done(GroupResult { missing: 0, ended: true });
            }
            State::Ended { missing: 0, refused } => self.end_without(refused, AbortCode::GENERAL),
            _ => {}
        }
    }

    /// Goes on after the last segment that a server has acknowledged. Who has not got so far stays
    /// behind.
    fn next_sub_block(&mut self, mut sent: Sent) {
        let data = self.data.as_ref();
        let ackseq = sent.range.map_or(0, |(_, last)| last);
        self.state = match sent.sub_block.acknowledged(BlockAck { ackseq, blksize: sent.blksize }, data) {
            Ok(Some(crc)) => State::End { crc },
            Ok(None) => State::Blocks(Sent { missing: self.servers, range: None, ..sent }),
            Err(code) => State::Break { result: GroupResult { missing: self.servers, ended: false }, code },
        };
    }

    /// After the end, a server that is left in its transfer gets an abort. The others ignore it.
    fn end_without(&mut self, missing: Servers, code: AbortCode) {
        self.state = State::Break { result: GroupResult { missing, ended: true }, code };
    }

    /// Returns the next action.
    pub fn poll(&mut self, now: Instant) -> GroupStep {
        let data = self.data.as_ref();
        let servers = self.servers;
        let bytes = match &mut self.state {
            State::Begin => {
                self.state = State::Initiated { missing: servers, crc: false, blksize: None };
                let size = u32::try_from(data.len()).ok();
                Request::InitiateBlockDownload { at: self.at, crc: true, size }.emit()
            }
            State::Blocks(Sent { sub_block, .. }) if !sub_block.is_sent(data) => sub_block.next(data).emit(),
            State::End { crc } => {
                let end = SubBlock::end(*crc, data);
                self.state = State::Ended { missing: servers, refused: 0 };
                Request::EndBlockDownload(end).emit()
            }
            State::Break { result, code } => {
                let code = *code;
                self.state = State::Done(*result);
                Request::Abort(self.at, code).emit()
            }
            State::Initiated { .. } | State::Blocks(_) | State::Ended { .. } => return self.wait(now),
            State::Done(result) => return GroupStep::Done(*result),
        };
        self.moved = now;
        GroupStep::Send(Frame::full(self.request, bytes))
    }

    /// Waits for the answers that are missing, and goes on without them when it is time.
    fn wait(&mut self, now: Instant) -> GroupStep {
        // A single answer may get lost. A server that has really missed a segment says so earlier.
        let others_have_all = match self.state {
            State::Blocks(Sent { sub_block, range: Some((first, _)), .. }) => sub_block.is_whole(first),
            _ => false,
        };
        let others_have_answered = match self.state {
            State::Initiated { blksize, .. } => blksize.is_some(),
            State::Ended { missing, .. } => missing != self.servers,
            _ => others_have_all,
        };
        let wait = if others_have_answered { LATE_MS.min(self.timeout_ms) } else { self.timeout_ms };
        let deadline = self.moved + wait;
        if !now.has_reached(deadline) {
            return GroupStep::Wait(deadline);
        }
        match self.state {
            State::Blocks(sent) if others_have_all => self.next_sub_block(sent),
            State::Ended { missing, refused } => self.end_without(missing | refused, AbortCode::TIMEOUT),
            State::Initiated { missing, .. } | State::Blocks(Sent { missing, .. }) => {
                let result = GroupResult { missing, ended: false };
                self.state = State::Break { result, code: AbortCode::TIMEOUT };
            }
            _ => {}
        }
        self.poll(now)
    }
}

/// Removes a server from a set; returns whether it was there.
fn take(set: &mut Servers, server: Servers) -> bool {
    let was_there = *set & server != 0;
    *set &= !server;
    was_there
}

//! Writing one value to several servers at once.

use crate::abort::AbortCode;
use crate::frame::{CobId, Frame};
use crate::od::Address;
use crate::sdo::block::check_blksize;
use crate::sdo::client::download::SubBlock;
use crate::sdo::client::Config;
use crate::sdo::wire::{Request, Response};
use crate::time::Instant;

/// A set of the servers of a group: bit n is server n.
pub type Servers = u128;

/// The most servers of a group.
pub const SERVERS_MAX: usize = Servers::BITS as usize;

/// A block download to several servers that have the same COB-ID for requests and different ones
/// for answers (1201h).
///
/// Nothing is sent twice: if one server misses a segment or refuses, the download is broken off for
/// all, and the caller begins it again. So the data must be such that a server which has taken them
/// already takes them again.
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
    Begun { missing: Servers, crc: bool, blksize: Option<u8> },
    /// A sub-block is being sent.
    Sending(SubBlock),
    /// It was sent, and servers have not acknowledged it yet; with the size of the next one.
    Sent { sub_block: SubBlock, missing: Servers, blksize: u8 },
    /// All data have arrived everywhere; the end must be sent.
    End { crc: u16 },
    /// Servers have not confirmed the end yet, or have refused it.
    Ended { missing: Servers, refused: Servers },
    /// The abort must be sent.
    Break { missing: Servers },
    /// The servers that have not taken the data.
    Done { missing: Servers },
}

/// The next action for a download.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GroupStep {
    /// Send this frame, and ask again.
    Send(Frame),
    /// Wait for frames, at most until this time.
    Wait(Instant),
    /// The download has ended; with the servers that have not taken the data. Every later call
    /// returns this, too.
    Done(Servers),
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
        let response = Response::parse(bytes);
        if let Some(Response::Abort(_, code)) = response {
            match &mut self.state {
                State::Begun { .. } | State::Sending(_) | State::Sent { .. } | State::End { .. } => {
                    self.state = State::Break { missing: server };
                }
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
                State::Begun { missing, crc, blksize },
                Some(Response::InitiateBlockDownload { at, crc: checks, blksize: granted }),
            ) if at == self.at => {
                // One server decides for all: the end carries one CRC, and a sub-block one size.
                if check_blksize(granted).is_err() || blksize.is_some_and(|other| other != granted) {
                    self.state = State::Break { missing: server };
                    return Ok(());
                }
                *blksize = Some(granted);
                *crc |= checks;
                take(missing, server)
            }
            (State::Sent { sub_block, missing, blksize }, Some(Response::AckBlockDownload(ack))) => {
                let is_first = *missing == self.servers;
                let fits = check_blksize(ack.blksize).is_ok() && (is_first || *blksize == ack.blksize);
                if !fits || !sub_block.is_whole(ack) {
                    self.state = State::Break { missing: server };
                    return Ok(());
                }
                *blksize = ack.blksize;
                take(missing, server)
            }
            // It has missed a segment and did not hear the next one for a while.
            (State::Sending(_), Some(Response::AckBlockDownload(_))) => {
                self.state = State::Break { missing: server };
                return Ok(());
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

    /// Goes on if all servers have answered.
    fn proceed(&mut self) {
        let data = self.data.as_ref();
        match &mut self.state {
            State::Begun { missing: 0, crc, blksize: Some(blksize) } => {
                self.state = State::Sending(SubBlock::new(*crc, *blksize));
            }
            State::Sent { sub_block, missing: 0, blksize } => {
                self.state = match sub_block.advance(*blksize, data) {
                    Some(crc) => State::End { crc },
                    None => State::Sending(*sub_block),
                };
            }
            State::Ended { missing: 0, refused } => self.state = State::Done { missing: *refused },
            _ => {}
        }
    }

    /// Returns the next action.
    pub fn poll(&mut self, now: Instant) -> GroupStep {
        let data = self.data.as_ref();
        let servers = self.servers;
        let bytes = match &mut self.state {
            State::Begin => {
                self.state = State::Begun { missing: servers, crc: false, blksize: None };
                let size = u32::try_from(data.len()).ok();
                Request::InitiateBlockDownload { at: self.at, crc: true, size }.emit()
            }
            State::Sending(sub_block) => {
                let segment = sub_block.next(data).emit();
                if sub_block.is_sent(data) {
                    let blksize = sub_block.blksize();
                    self.state = State::Sent { sub_block: *sub_block, missing: servers, blksize };
                }
                segment
            }
            State::End { crc } => {
                let end = SubBlock::end(*crc, data);
                self.state = State::Ended { missing: servers, refused: 0 };
                Request::EndBlockDownload(end).emit()
            }
            State::Break { missing } => {
                self.state = State::Done { missing: *missing };
                Request::Abort(self.at, AbortCode::GENERAL).emit()
            }
            State::Begun { missing, .. } | State::Sent { missing, .. } | State::Ended { missing, .. } => {
                let deadline = self.moved + self.timeout_ms;
                if !now.has_reached(deadline) {
                    return GroupStep::Wait(deadline);
                }
                let missing = *missing;
                let refused = if let State::Ended { refused, .. } = self.state { refused } else { 0 };
                self.state = State::Done { missing: missing | refused };
                Request::Abort(self.at, AbortCode::TIMEOUT).emit()
            }
            State::Done { missing } => return GroupStep::Done(*missing),
        };
        self.moved = now;
        GroupStep::Send(Frame::full(self.request, bytes))
    }
}

/// Removes a server from a set; returns whether it was there.
fn take(set: &mut Servers, server: Servers) -> bool {
    let was_there = *set & server != 0;
    *set &= !server;
    was_there
}

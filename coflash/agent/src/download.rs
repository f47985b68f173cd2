//! Artifacts: fetched piece by piece into a file, and checked as a whole.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::time::{Duration, Instant};

use sha2::{Digest, Sha256};

use super::config::Token;
use super::controller::{Piece, Wanted};
use super::http::Client;
use coflash_core::file::sealed::show::digits;

/// When a transfer pauses.
pub(super) struct Pause<'p> {
    /// After this time, if the server can go on where it ended: the agent looks after other things.
    pub(super) after: Duration,
    /// At once, if this is true: the agent is being ended.
    pub(super) now: &'p dyn Fn() -> bool,
}

/// How many times that long a transfer may take that cannot pause.
const LONGEST: u32 = 30;

/// Fetches the next piece of a file into `path`, after what is there.
pub(super) fn fetch(
    client: &Client,
    token: &Token,
    wanted: &Wanted,
    path: &Path,
    pause: &Pause<'_>,
) -> Piece {
    match piece(client, token, wanted, path, pause) {
        Ok(Piece::Wrong(why)) => {
            // The next attempt begins anew.
            let _ = fs::remove_file(path);
            Piece::Wrong(why)
        }
        Ok(piece) => piece,
        Err(error) => {
            let why = format!("{}: {error}", path.display());
            Piece::Cut { at: 0, why, retry_after: None }
        }
    }
}

fn piece(
    client: &Client,
    token: &Token,
    wanted: &Wanted,
    path: &Path,
    pause: &Pause<'_>,
) -> io::Result<Piece> {
    if path.is_symlink() {
        // None of ours: what is behind it stays as it is.
        fs::remove_file(path)?;
    }
    let mut file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path)?;
    let mut at = file.metadata()?.len();
    if at >= wanted.size {
        if at == wanted.size && is_right(&mut file, wanted)? {
            return Ok(Piece::Whole);
        }
        // It is the file of an earlier action.
        file.set_len(0)?;
        at = 0;
    }
    let cut = |at, why, retry_after| Ok(Piece::Cut { at, why, retry_after });
    let mut opened = match client.open(&wanted.link, token, at) {
        Ok(opened) => opened,
        Err(why) => return cut(at, why, None),
    };
    let goes_on = match opened.status {
        206 if opened.header("content-range").and_then(first_byte) == Some(at) => true,
        200 => {
            at = 0;
            opened.header("accept-ranges").is_some_and(|units| units.contains("bytes"))
        }
        206 | 416 => {
            file.set_len(0)?;
            return cut(0, "the server gives another part of the file than asked for".to_string(), None);
        }
        status => {
            let why = format!("the server answers with status {status} in place of the file");
            return cut(at, why, opened.retry_after());
        }
    };
    if let Some(length) = opened.body.content_length().filter(|length| at + length != wanted.size) {
        let sizes = format!("the server sends {} bytes and has announced {}", at + length, wanted.size);
        return Ok(Piece::Wrong(sizes));
    }
    file.set_len(at)?;
    file.seek(SeekFrom::Start(at))?;
    receive(opened.body.as_reader(), (&mut file, at), wanted, pause, goes_on)
}

/// Receives a file from the byte `at` on, and checks it.
fn receive(
    mut reader: impl Read,
    (file, mut at): (&mut File, u64),
    wanted: &Wanted,
    pause: &Pause<'_>,
    goes_on: bool,
) -> io::Result<Piece> {
    let cut = |at, why| Ok(Piece::Cut { at, why, retry_after: None });
    let began = Instant::now();
    let limit = if goes_on { pause.after } else { pause.after * LONGEST };
    let mut buffer = [0; 16 * 1024];
    loop {
        let is_late = began.elapsed() >= limit;
        if (pause.now)() || goes_on && is_late {
            return Ok(Piece::More { at });
        }
        if is_late {
            // Each attempt would be like this one.
            return cut(0, "the transfer takes too long, and the server cannot go on later".to_string());
        }
        match reader.read(&mut buffer) {
            Ok(0) => break,
            Ok(count) => {
                at += count as u64;
                if at > wanted.size {
                    let what = format!("the server sends more than the {} bytes announced", wanted.size);
                    return Ok(Piece::Wrong(what));
                }
                file.write_all(&buffer[..count])?;
            }
            Err(error) => return cut(at, format!("the transfer broke off: {error}")),
        }
    }
    if at < wanted.size {
        return cut(at, format!("the transfer ended after {at} of {} bytes", wanted.size));
    }
    file.sync_all()?;
    Ok(match is_right(file, wanted)? {
        true => Piece::Whole,
        false => Piece::Wrong("its SHA-256 is another than the server has announced".to_string()),
    })
}

/// The number of the first byte in `bytes 5-9/10`.
fn first_byte(range: &str) -> Option<u64> {
    range.strip_prefix("bytes ")?.split('-').next()?.parse().ok()
}

fn is_right(file: &mut File, wanted: &Wanted) -> io::Result<bool> {
    file.seek(SeekFrom::Start(0))?;
    let mut digest = Sha256::new();
    let mut buffer = [0; 16 * 1024];
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok(digits(&digest.finalize()) == wanted.sha256),
            count => digest.update(&buffer[..count]),
        }
    }
}

/// The bytes of a file that was fetched, checked once more: what is flashed is what was checked.
///
/// # Errors
/// In words, if the file is missing or was changed.
pub(super) fn bytes(path: &Path, wanted: &Wanted) -> Result<Vec<u8>, String> {
    let bytes =
        coflash_core::file::limit::read(path).map_err(|cause| format!("{}: {cause}", path.display()))?;
    if bytes.len() as u64 != wanted.size || digits(&Sha256::digest(&bytes)) != wanted.sha256 {
        return Err(format!("{}: it was changed after it was checked", path.display()));
    }
    Ok(bytes)
}

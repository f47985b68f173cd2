//! A session with a node behind a gateway: the gateway's SDO client does the transfers.

use std::sync::atomic::Ordering;
use std::time::Duration;

use canopen::{AbortCode, Address};

use super::transfer::WORTH_BLOCKS;
use super::{Access, Session};
use crate::device::doing::Doing;
use crate::device::error::{of_gateway, Error};
use coboot_can::gateway::{Ask, Gateway, GatewayError};

/// How much longer than its node a gateway may take for a short value.
const GATEWAY_GRACE: Duration = Duration::from_secs(5);
/// The bytes of a value that the slowest bus carries in a second: 10 kbit/s, in segments, with
/// other traffic.
const GATEWAY_BYTES: u64 = 250;

impl Session<'_> {
    /// Reads a value of at most this length through the gateway. Its first characters are due after the
    /// time-out of the node and of the gateway; what a gateway collects before it answers must arrive by
    /// then, too.
    pub(super) fn upload_there(
        &mut self,
        at: Address,
        longest: usize,
        progress: &mut dyn FnMut(u32),
    ) -> Result<Vec<u8>, Error> {
        let (doing, patience) = (Doing::Read(at), self.timing.sdo + GATEWAY_GRACE);
        let value =
            self.through_gateway(at, doing, patience, longest, |gateway, ask| gateway.upload(ask, progress))?;
        if value.len() > longest {
            return Err(Error::Protocol { doing, code: AbortCode::OUT_OF_MEMORY });
        }
        Ok(value)
    }

    /// Writes a value through the gateway.
    pub(super) fn write_there(
        &mut self,
        at: Address,
        data: &[u8],
        doing: Doing,
        progress: &mut dyn FnMut(u32),
    ) -> Result<(), Error> {
        let patience = match data.len() {
            0..=WORTH_BLOCKS => self.timing.sdo + GATEWAY_GRACE,
            len => self.timing.command + Duration::from_secs(len as u64 / GATEWAY_BYTES),
        };
        self.through_gateway(at, doing, patience, 0, |gateway, ask| gateway.download(ask, data, progress))
    }

    /// Runs a request of the gateway, and returns its result in the form of a transfer over the
    /// bus.
    fn through_gateway<T>(
        &mut self,
        at: Address,
        doing: Doing,
        patience: Duration,
        longest: usize,
        act: impl FnOnce(&mut dyn Gateway, &Ask<'_>) -> Result<T, GatewayError>,
    ) -> Result<T, Error> {
        self.check_cancelled()?;
        let flag = self.cancelled.clone();
        let cancelled = move || flag.as_ref().is_some_and(|flag| flag.load(Ordering::Relaxed));
        let (node, sdo) = (self.node, self.timing.sdo);
        let ask = Ask { node, at, sdo, patience, longest, cancelled: &cancelled };
        match &mut self.access {
            Access::Gateway(gateway) => {
                act(&mut **gateway, &ask).map_err(|error| of_gateway(error, node, doing))
            }
            // Callers have checked that there is a gateway.
            Access::Bus(_) => Err(Error::NoAnswer { node, doing }),
        }
    }
}

//! Between the slave and the CAN controller.

use bsp::{line, CanPort};
use canopen::slave::{Output, Slave, SlaveDevice};
use canopen::{CobId, Instant};
use rtic::Mutex;

use crate::entries::PDOS;
use crate::process::OWN;

/// Those of the slave, of SYNC, of the RPDOs (each PDO has room) and of the application.
const IDENTIFIERS: usize = 4 + 1 + PDOS.len() + OWN.len();

/// Carries out the slave's actions until there are none left.
pub fn carry_out(
    slave: &mut Slave,
    can: &mut impl Mutex<T = CanPort>,
    now: Instant,
    device: &mut impl SlaveDevice,
) {
    while let Some(output) = slave.poll(now, can.lock(CanPort::has_room), device) {
        can.lock(|can| match output {
            Output::Accept(ids) => can.accept(identifiers(ids, device)),
            output => line::carry_out(can, output),
        });
    }
}

/// All identifiers to accept; the first one again in the place of a PDO that does not exist.
fn identifiers(of_slave: [CobId; 4], device: &mut impl SlaveDevice) -> [u16; IDENTIFIERS] {
    core::array::from_fn(|n| {
        let own = || device.exchange()?.identifier(n - of_slave.len());
        of_slave.get(n).copied().or_else(own).unwrap_or(of_slave[0]).get()
    })
}

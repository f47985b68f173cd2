//! Between the slave and the CAN controller.

use bsp::{line, CanPort};
use canopen::slave::{Slave, SlaveDevice};
use canopen::Instant;
use rtic::Mutex;

/// Carries out the slave's actions until there are none left.
pub fn carry_out(
    slave: &mut Slave,
    can: &mut impl Mutex<T = CanPort>,
    now: Instant,
    device: &mut impl SlaveDevice,
) {
    while let Some(output) = slave.poll(now, can.lock(CanPort::has_room), device) {
        can.lock(|can| line::carry_out(can, output));
    }
}

//! What the manual's download tools have and this one does otherwise (tables 9 and 11): accepted,
//! so that a script works by changing the program's name.

use clap::Args;
use coflash::lss::LssAddress;

use super::output::Failure;
use super::values::number;
use super::Context;

/// The options that mean nothing here, or something that is said otherwise.
#[derive(Debug, Args)]
#[command(next_help_heading = "Options of the manual's tools")]
pub(super) struct Legacy {
    /// The bit rate as an index (0 is 1 Mbit/s, 2 is 500, 3 is 250, 4 is 125 kbit/s), for adapters
    /// that set it.
    #[arg(short = 'B', alias = "br_idx", long = "bit-rate-index", value_name = "0..8", value_parser = bit_rate_of_index)]
    index: Option<u32>,

    /// The bit rate in kbit/s, for adapters that set it.
    #[arg(long, alias = "baurate", value_name = "KBITS", value_parser = kilobits, overrides_with = "index")]
    baudrate: Option<u32>,

    /// A value above 0 is --check-target.
    #[arg(long = "chk_tgt", value_name = "VALUE", value_parser = number, hide = true)]
    chk_tgt: Option<u32>,

    /// Give the device with this LSS address the node-ID of --node first: its serial number.
    #[arg(long = "ser_num", value_name = "NUMBER", value_parser = number)]
    serial: Option<u32>,

    /// The same: its revision.
    #[arg(long = "rev", value_name = "NUMBER", value_parser = number)]
    revision: Option<u32>,

    /// The same: its product code.
    #[arg(long = "pcode", value_name = "NUMBER", value_parser = number)]
    product: Option<u32>,

    /// The same: its vendor-ID; 0x3F unless told otherwise.
    #[arg(long = "vendor", value_name = "NUMBER", value_parser = number)]
    vendor: Option<u32>,

    #[arg(long = "vxd_type", value_name = "VALUE", hide = true)]
    vxd_type: Option<String>,

    #[arg(long = "device_no", value_name = "VALUE", hide = true)]
    device_no: Option<String>,

    #[arg(long = "ip_addr", value_name = "VALUE", hide = true)]
    ip_addr: Option<String>,

    #[arg(long = "ip_port", value_name = "VALUE", hide = true)]
    ip_port: Option<String>,

    #[arg(long = "gateway_id", value_name = "VALUE", value_parser = number, hide = true)]
    gateway_id: Option<u32>,

    #[arg(long = "network_id", value_name = "VALUE", value_parser = number, hide = true)]
    network_id: Option<u32>,
}

impl Legacy {
    /// Refuses what cannot be done, and tells what is passed over.
    pub(super) fn check(&self, context: &Context) -> Result<(), Failure> {
        if self.gateway_id.unwrap_or(0) != 0 || self.network_id.unwrap_or(0) != 0 {
            let advice = "connect the adapter to the device's own network, and leave --gateway_id and --network_id out";
            return Err(Failure::usage("devices behind an SDO gateway cannot be reached", advice));
        }
        for (name, value) in [
            ("--vxd_type", &self.vxd_type),
            ("--device_no", &self.device_no),
            ("--ip_addr", &self.ip_addr),
            ("--ip_port", &self.ip_port),
        ] {
            if value.is_some() {
                context.out.warn(format_args!("{name} is passed over: the adapter is what --bus says"));
            }
        }
        Ok(())
    }

    /// The LSS address, if any part of it was given; the other parts have the manual's defaults
    /// (table 9).
    pub(super) fn address(&self) -> Option<LssAddress> {
        let parts = [self.vendor, self.product, self.revision, self.serial];
        parts.iter().any(Option::is_some).then(|| LssAddress {
            vendor_id: self.vendor.unwrap_or(0x3F),
            product_code: self.product.unwrap_or(0),
            revision: self.revision.unwrap_or(0),
            serial_number: self.serial.unwrap_or(0),
        })
    }

    /// Whether the old spelling of `--check-target` was given.
    pub(super) fn check_target(&self) -> bool {
        self.chk_tgt.is_some_and(|value| value > 0)
    }

    /// In bit/s.
    pub(super) fn bit_rate(&self) -> Option<u32> {
        self.baudrate.or(self.index)
    }
}

/// Table 13.
fn bit_rate_of_index(text: &str) -> Result<u32, String> {
    const KILOBITS: [u32; 9] = [1000, 800, 500, 250, 125, 100, 50, 20, 10];
    let index = number(text)? as usize;
    let kilobits = KILOBITS.get(index).ok_or("bit rates are 0 (1 Mbit/s) to 8 (10 kbit/s)")?;
    Ok(kilobits * 1000)
}

fn kilobits(text: &str) -> Result<u32, String> {
    match number(text)? {
        kilobits @ 1..=1000 => Ok(kilobits * 1000),
        _ => Err("bit rates are 1 to 1000 kbit/s".to_string()),
    }
}

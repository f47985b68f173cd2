//! `coflash seal verify-device`: checks whether a device holds the program of a sealed image.

use clap::Args;
use coflash_core::device::delivery::{delivery, Delivery};
use coflash_core::device::option_bytes::sector_list;
use coflash_core::file::sealed::Device as Target;
use coflash_core::update::{compare_sealed, Comparison};
use serde_json::json;

use crate::context::Context;
use crate::device::Device;
use crate::output::Failure;
use crate::seal::verify::Checked;

/// Checks whether a device holds exactly the program of a sealed image.
///
/// The file is checked as verify does. Then it is compared with the device's answers, in the
/// bootloader or in the application: vendor-ID, product code, hardware revision, unique ID and keys
/// of the device, CRC and version of the program, and the last installation. The command changes
/// nothing in the device.
///
/// A device fails also if its bootloader runs on trial, waits for a trial, is confirmed and not
/// installed, or is damaged, and if SPRMOD or BFB2 is set in its option bytes. An application
/// reports none of this: coflash enter calls the bootloader first.
///
/// The answers come from the device's own software: a device with foreign software may give any
/// answers.
#[derive(Debug, Args)]
pub(crate) struct VerifyDevice {
    #[command(flatten)]
    checked: Checked,

    #[command(flatten)]
    device: Device,
}

impl VerifyDevice {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        let path = &self.checked.file;
        let (file, opened) = self.checked.check(&Target::default())?;
        let mut link = context.link()?;
        let mut session = self.device.session(&mut link)?;
        let comparison =
            compare_sealed(&mut session, &file).map_err(|error| Failure::diagnosed(error, &mut session))?;
        let Delivery { renewal, option_bytes, faults, unanswered: unknown, .. } =
            delivery(&mut session).map_err(|error| Failure::diagnosed(error, &mut session))?;
        let (node, program) = (session.node(), file.head().program());
        let Comparison { running, runs, differences, unanswered, .. } = &comparison;
        let unanswered = [&unanswered[..], &unknown].concat();
        let which = format!("program {program} of {}", path.display());
        let verdict = match (comparison.is_same(), runs) {
            (true, true) => format!("runs {which}, according to its own answers"),
            (true, false) => format!("holds {which} and does not run it, according to its own answers"),
            (false, _) => format!("is not the device of {which}, or has another program"),
        };
        let mut words = format!("node {node}: {verdict}\n  running      {running}");
        words += &format!("\n  signed by    key {:08X}h", opened.signed_by.id());
        for difference in differences {
            words += &format!("\n  differs      {difference}");
        }
        for fault in &faults {
            words += &format!("\n  not ready    {fault}");
        }
        let protected = option_bytes.map(|bytes| bytes.protected());
        if let (Some(renewal), Some(protected)) = (renewal, protected) {
            let wanted = match renewal {
                true => "sector 0 and no others: the bootloader can be renewed",
                false => "the sectors that coflash seal provision names (0 and 4 on the boards of coboot)",
            };
            words +=
                &format!("\n  protection   the device has {}; it needs {wanted}", sector_list(protected));
        }
        if !unanswered.is_empty() {
            let objects: Vec<String> = unanswered.iter().map(ToString::to_string).collect();
            words += &format!("\n  not reported {}", objects.join(", "));
        }
        context.result(words, || {
            json!({
                "node": node.get(),
                "program": program,
                "same": comparison.is_same(),
                "runs": runs,
                "device_type": running.0,
                "bootloader": running.is_bootloader(),
                "signed_by": opened.signed_by.id(),
                "differences": differences,
                "ready": faults.is_empty(),
                "faults": faults,
                "renewal": renewal,
                "option_bytes": option_bytes,
                "protected": protected,
                "unanswered": unanswered.iter().map(ToString::to_string).collect::<Vec<_>>(),
            })
        });
        match (comparison.is_same(), faults.is_empty()) {
            (true, true) => Ok(()),
            (true, false) => Err(Failure::not_ready(node)),
            (false, _) => Err(Failure::differs(node, differences.len())),
        }
    }
}

//! What a command byte stands for (Telegram listing table 7-1).

use crate::lms::telegram::REPLY;

/// What `command` is called; of a reply what it answers. `None` for one that is not known here.
pub fn name(command: u8, is_reply: bool) -> Option<&'static str> {
    if !is_reply {
        return request(command);
    }
    match command {
        0x90 => Some("power on"),
        0x91 => Some("reset begins"),
        0x92 => Some("command refused"),
        0xB0 => Some("measured values"),
        _ => request(command.checked_sub(REPLY)?),
    }
}

fn request(command: u8) -> Option<&'static str> {
    Some(match command {
        0x10 => "reset",
        0x20 => "change of operating mode",
        0x30 => "measured values, once",
        0x31 => "status",
        0x32 => "errors",
        0x35 => "operating data counters",
        0x36 => "mean values",
        0x37 => "values of a sub-range",
        0x3A => "type and firmware",
        0x3B => "switch of angle and resolution",
        0x3E => "values of a sub-range with field values",
        0x3F => "mean values of a sub-range",
        0x40 => "write of a field",
        0x41 => "switch of the field set",
        0x42 => "change of the password",
        0x44 => "ranges and reflectivity (S14)",
        0x45 => "field",
        0x46 => "teaching of a field",
        0x4A => "state of the field outputs",
        0x66 => "write of the rate after power-on",
        0x69 => "positioning aid",
        0x74 => "configuration, part 1",
        0x75 => "ranges and reflectivities",
        0x76 => "Cartesian coordinates",
        0x77 => "write of the configuration, part 1",
        0x7B => "configuration, part 2",
        0x7C => "write of the configuration, part 2",
        0x0B
        | 0x0C
        | 0x33
        | 0x34
        | 0x38
        | 0x39
        | 0x3C
        | 0x3D
        | 0x48
        | 0x4B..=0x52
        | 0x67
        | 0x68
        | 0x70
        | 0x72
        | 0x78..=0x7A => "reserved",
        _ => return None,
    })
}

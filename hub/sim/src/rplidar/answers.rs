//! What a scanner answers to a request of one answer, byte exact: a descriptor, then its data. Knows no times.

use super::models::{Mode, Model};

/// `A5 5A`, the length of what follows in 30 bits, in the upper two whether more follow, and the type.
fn descriptor(len: usize, follows: bool, answer: u8) -> Vec<u8> {
    let word = len as u32 | u32::from(follows) << 30;
    [&[0xA5, 0x5A][..], &word.to_le_bytes(), &[answer]].concat()
}

fn answer(data: &[u8], kind: u8) -> Vec<u8> {
    [descriptor(data.len(), false, kind), data.to_vec()].concat()
}

/// What stands before the packets of a stream in `mode`.
pub(crate) fn stream(mode: &Mode) -> Vec<u8> {
    descriptor(mode.form.packet_len(), true, mode.form.answer())
}

/// Model, firmware, hardware, and the number of the one that `seed` is.
pub(crate) fn info(model: Model, seed: u64) -> Vec<u8> {
    let ([major, minor], hardware) = model.versions();
    let mut random = fastrand::Rng::with_seed(seed ^ u64::from(model.id()) << 32);
    let serial: [u8; 16] = std::array::from_fn(|_| random.u8(..));
    answer(&[&[model.id(), minor, major, hardware][..], &serial].concat(), 0x04)
}

/// 0 good, 1 warning or 2 error, and a code.
pub(crate) fn health(status: u8, code: u16) -> Vec<u8> {
    let [low, high] = code.to_le_bytes();
    answer(&[status, low, high], 0x06)
}

/// Microseconds a point in the standard mode, and in the first express one.
pub(crate) fn sample_rate(model: Model) -> Vec<u8> {
    let micros = |number: usize| (model.modes()[number].sample_us.round() as u16).to_le_bytes();
    answer(&[micros(0), micros(1)].concat(), 0x15)
}

/// The value of `key` for mode number `mode`; nothing for a key or mode that it does not have.
pub(crate) fn configuration(model: Model, typical: usize, key: u32, mode: u16) -> Option<Vec<u8>> {
    let of = model.modes().get(usize::from(mode));
    let eighths = |value: f64| ((value * 256.0).round() as u32).to_le_bytes().to_vec();
    let value = match key {
        // Revolutions a minute that it wants, and the duty cycle for them.
        0x01 => {
            let rpm = (60.0 * model.turns_per_second()).round() as u16;
            [rpm.to_le_bytes(), PWM.to_le_bytes()].concat()
        }
        0x70 => (model.modes().len() as u16).to_le_bytes().to_vec(),
        0x71 => eighths(of?.sample_us),
        0x74 => eighths(of?.reach_m),
        0x75 => vec![of?.form.answer()],
        0x7C => (typical as u16).to_le_bytes().to_vec(),
        0x7F => [of?.name.as_bytes(), &[0]].concat(),
        _ => return None,
    };
    Some(answer(&[&key.to_le_bytes()[..], &value].concat(), 0x20))
}

/// That a value of the configuration is set.
pub(crate) fn is_set(key: u32) -> Vec<u8> {
    answer(&[key.to_le_bytes(), 0u32.to_le_bytes()].concat(), 0x21)
}

/// What the accessory board can do: bit 0 says that it has a motor to steer.
pub(crate) fn board(steers: bool) -> Vec<u8> {
    answer(&[u8::from(steers), 0, 0, 0], 0xFF)
}

/// What it says of itself when it has started: 64 bytes of ASCII.
pub(crate) fn banner(model: Model) -> Vec<u8> {
    let ([major, minor], hardware) = model.versions();
    let text = format!(
        "RP LIDAR System.\r\nFirmware Ver {major}.{minor}, HW Ver {hardware}\r\nModel: {:02x}",
        model.id()
    );
    let mut bytes = text.into_bytes();
    bytes.resize(BANNER - 2, b' ');
    bytes.extend(b"\r\n");
    bytes
}

/// The duty cycle of the turns in a second that a scanner wants, of 1,023; the vendor's default.
pub(crate) const PWM: u16 = 660;
const BANNER: usize = 64;

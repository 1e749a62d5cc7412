//! The first part of a scanner's configuration, which 74h reads and 77h writes: 34 bytes, or 32 with older firmware
//! (Telegram listing, 77h blocks A to P).

use crate::lms::variant::{Mode, Unit};

/// Bytes of a configuration, in the scanner's layout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Configuration<'a>(&'a [u8]);

impl<'a> Configuration<'a> {
    /// Returns the configuration in `bytes`. Returns `None` if `bytes` is shorter than 32 bytes.
    pub fn new(bytes: &'a [u8]) -> Option<Configuration<'a>> {
        (bytes.len() >= OLD_CONFIGURATION_LEN).then_some(Configuration(bytes))
    }

    /// Returns the bytes in the scanner's layout.
    pub fn bytes(&self) -> &'a [u8] {
        self.0
    }

    /// Returns the availability byte: bit 0 is availability level 3, bit 1 real-time indices, bit 2 availability level
    /// 2.
    pub fn availability(&self) -> u8 {
        self.0[4]
    }

    /// Returns whether telegrams of values end with the two real-time indices.
    pub fn has_indices(&self) -> bool {
        self.availability() & REAL_TIME_INDICES != 0
    }

    /// Returns the measuring mode, which determines the range bits and the upper bits of a value.
    pub fn mode(&self) -> Mode {
        Mode(self.0[5])
    }

    /// Returns the unit of the ranges, or `None` for an unknown code.
    pub fn unit(&self) -> Option<Unit> {
        Unit::of_code(self.0[6])
    }
}

/// Returns the configuration of a factory-new scanner whose measuring mode is `mode` and whose unit is `unit`.
pub fn factory_configuration(mode: Mode, unit: Unit) -> [u8; CONFIGURATION_LEN] {
    let mut bytes = [0; CONFIGURATION_LEN];
    bytes[2] = 0x70;
    bytes[5] = mode.0;
    bytes[6] = unit.code();
    bytes[9] = 2;
    bytes[10] = 2;
    bytes[32] = 2;
    bytes
}

/// Location and name of one value of the configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Item {
    /// Index of the first byte.
    pub at: usize,
    /// Number of bytes: 1, or 2 for a word.
    pub len: usize,
    /// Name for users.
    pub name: &'static str,
}

/// All values of a configuration. Their order is the order of the bytes, without gaps.
pub const ITEMS: [Item; 31] = {
    const fn byte(at: usize, name: &'static str) -> Item {
        Item { at, len: 1, name }
    }
    const fn word(at: usize, name: &'static str) -> Item {
        Item { at, len: 2, name }
    }
    [
        word(0, "blanking"),
        byte(2, "stop threshold"),
        byte(3, "peak threshold or sensitivity"),
        byte(4, "availability"),
        byte(5, "measuring mode"),
        byte(6, "unit"),
        byte(7, "temporary field"),
        byte(8, "subtractive fields"),
        byte(9, "multiple evaluation"),
        byte(10, "restart"),
        byte(11, "restart time"),
        byte(12, "second multiple evaluation"),
        byte(13, "contour A reference"),
        byte(14, "contour A tolerance above"),
        byte(15, "contour A tolerance below"),
        byte(16, "contour A start"),
        byte(17, "contour A stop"),
        byte(18, "contour B reference"),
        byte(19, "contour B tolerance above"),
        byte(20, "contour B tolerance below"),
        byte(21, "contour B start"),
        byte(22, "contour B stop"),
        byte(23, "contour C reference"),
        byte(24, "contour C tolerance above"),
        byte(25, "contour C tolerance below"),
        byte(26, "contour C start"),
        byte(27, "contour C stop"),
        byte(28, "pixel oriented evaluation"),
        byte(29, "single value evaluation"),
        word(30, "restart times B and C"),
        word(32, "multiple evaluation when dazzled"),
    ]
};

/// Returns the meaning of the availability byte `byte` as text.
pub fn availability_text(byte: u8) -> &'static str {
    match byte & 7 {
        0 => "level 1",
        1 => "level 3",
        2 => "level 1, real-time indices",
        3 => "level 3, real-time indices",
        4 => "level 2",
        6 => "level 2, real-time indices",
        5 => "levels 2 and 3",
        _ => "levels 2 and 3, real-time indices",
    }
}

/// Number of bytes of a configuration.
pub const CONFIGURATION_LEN: usize = 34;
/// Number of bytes of a configuration with older firmware.
pub const OLD_CONFIGURATION_LEN: usize = 32;
/// Bit of the availability byte that makes telegrams of values end with the two real-time indices.
pub const REAL_TIME_INDICES: u8 = 2;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn configuration_items_are_contiguous() {
        let end = ITEMS.iter().fold(0, |at, item| {
            assert_eq!(item.at, at, "{}", item.name);
            at + item.len
        });
        assert_eq!(end, CONFIGURATION_LEN);
    }

    #[test]
    fn accepts_both_configuration_lengths() {
        let mut bytes = factory_configuration(Mode(4), Unit::Mm);
        bytes[4] = 3;
        assert_eq!(Configuration::new(&bytes[..31]), None);
        for len in [OLD_CONFIGURATION_LEN, CONFIGURATION_LEN] {
            let configuration = Configuration::new(&bytes[..len]).unwrap();
            assert_eq!((configuration.mode(), configuration.unit()), (Mode(4), Some(Unit::Mm)));
            assert!(configuration.has_indices());
        }
    }
}

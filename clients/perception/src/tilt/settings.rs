//! What can be set beside the mount. Refuses to know files.

/// How sweeps, background and obstacles are found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// A scan waits so long, in ns of the stamps, for the angles of its beams.
    pub delay_ns: u64,
    /// Two angles farther apart in time do not say what was between them.
    pub gap_ns: u64,
    /// No mount turns faster, in radians a second: what does is a jump of its encoder.
    pub fastest_rad_s: f64,
    /// So far from the rates that it is given with may the way between two angles be, in radians a second.
    pub rate_rad_s: f64,
    /// After a jump so much time has to pass without another one.
    pub settle_ns: u64,
    /// The angle has to go back by so much to have turned.
    pub turn_rad: f64,
    /// With less than [`turn_rad`](Self::turn_rad) a tenth in this time the mount stands.
    pub standing_ns: u64,
    /// Width of a cell of the background in angles of the mount.
    pub bin_rad: f64,
    /// So far before the background is foreground, in metres.
    pub threshold_m: f64,
    /// Sweeps in which a surface must be seen before it is background.
    pub sweeps: u16,
    /// A sweep in which a greater share of the known background is not where it was contradicts its angles.
    pub doubt: f64,
    /// So does one in a part of which the floor is where it would be if the angles were off by more, in radians.
    pub off_rad: f64,
    /// The least points of an obstacle.
    pub points: usize,
    /// Points of an obstacle are in cubes of this width that touch, in metres.
    pub cube_m: f64,
    /// What is in here is an obstacle whether it is background or not: the least and greatest x, y and z in the robot's frame.
    pub near: Option<[[f64; 2]; 3]>,
}

impl Default for Settings {
    fn default() -> Settings {
        Settings {
            delay_ns: 300_000_000,
            gap_ns: 100_000_000,
            fastest_rad_s: 180_f64.to_radians(),
            rate_rad_s: 10_f64.to_radians(),
            settle_ns: 500_000_000,
            turn_rad: 2_f64.to_radians(),
            standing_ns: 400_000_000,
            bin_rad: 1_f64.to_radians(),
            threshold_m: 0.06,
            sweeps: 5,
            doubt: 0.3,
            off_rad: 0.25_f64.to_radians(),
            points: 8,
            cube_m: 0.15,
            near: None,
        }
    }
}

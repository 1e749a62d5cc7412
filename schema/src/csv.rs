//! A scan as a line of CSV. Refuses to know where lines go.

use std::io::{self, Write};

use crate::{Header, Scan, in_degrees};

/// Writes the names of the columns of scans with so many beams, without a line's end.
///
/// # Errors
///
/// The error of `out`, or of what it writes to.
pub fn columns(line: &mut impl Write, beams: usize) -> io::Result<()> {
    write!(line, "seq,topic_seq,stamp_ns,wall_ns,quality,unit_um,first_angle_deg,step_deg")?;
    (0..beams).try_for_each(|i| write!(line, ",range_{i}"))
}

/// Writes the columns of `scan`, without a line's end: ranges in device units, nothing where there is no reading.
///
/// # Errors
///
/// The error of what it writes to.
pub fn row(line: &mut impl Write, header: &Header, scan: &Scan) -> io::Result<()> {
    let (stamp_ns, wall_ns) = (header.stamp_first_ns, header.wall_ns);
    write!(line, "{},{},{stamp_ns},{wall_ns},{}", header.seq, header.topic_seq, header.quality().name())?;
    write!(line, ",{},{},{}", scan.unit_um, in_degrees(scan.first_angle), in_degrees(scan.step))?;
    (0..scan.beams()).try_for_each(|i| match scan.range(i) {
        Some(range) => write!(line, ",{range}"),
        None => write!(line, ","),
    })
}

//! Rows of CSV for scans and marks.

use std::io::{self, Write};

use crate::{Header, Marks, Scan, in_degrees};

/// Columns of a scan that depend on options.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ScanColumns {
    /// Whether ranges are in meters instead of device units. Column `unit_um` is then 1000000.
    pub meters: bool,
    /// Whether columns `intensity_0`, `intensity_1` .. follow the ranges.
    pub intensities: bool,
}

impl ScanColumns {
    /// Writes the names of the columns of scans with `beams` beams, without a line end.
    ///
    /// # Errors
    ///
    /// Returns the error of `line`.
    pub fn write_header(self, line: &mut impl Write, beams: usize) -> io::Result<()> {
        write!(line, "{STAMP_COLUMNS},unit_um,first_angle_deg,step_deg")?;
        (0..beams).try_for_each(|i| write!(line, ",range_{i}"))?;
        let intensities = if self.intensities { beams } else { 0 };
        (0..intensities).try_for_each(|i| write!(line, ",intensity_{i}"))
    }

    /// Writes the columns of `scan`, without a line end. The range of a beam without a reading is empty, and so are
    /// intensities that the scanner does not send.
    ///
    /// # Errors
    ///
    /// Returns the error of `line`.
    pub fn write_row(self, line: &mut impl Write, header: &Header, scan: &Scan) -> io::Result<()> {
        write_stamps(line, header)?;
        let unit_um = if self.meters { UM_PER_M } else { scan.unit_um };
        write!(line, ",{unit_um},{},{}", in_degrees(scan.first_angle), in_degrees(scan.step))?;
        for i in 0..scan.beams() {
            match (scan.distance_m(i), scan.range(i)) {
                (Some(range_m), _) if self.meters => write!(line, ",{range_m}")?,
                (_, Some(range)) => write!(line, ",{range}")?,
                (_, None) => write!(line, ",")?,
            }
        }
        let intensities = scan.intensities();
        for i in 0..if self.intensities { scan.beams() } else { 0 } {
            match intensities.get(i) {
                Some(intensity) => write!(line, ",{intensity}")?,
                None => write!(line, ",")?,
            }
        }
        Ok(())
    }
}

/// Columns of marks. A scan has one row for each of its marks, or a single row if it has no marks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MarkColumns {
    /// Whether ranges are in meters instead of millimeters.
    pub meters: bool,
}

impl MarkColumns {
    /// Writes a line with the names of the columns.
    ///
    /// # Errors
    ///
    /// Returns the error of `out`.
    pub fn write_header(self, out: &mut impl Write) -> io::Result<()> {
        let range = if self.meters { "range_m" } else { "range_mm" };
        writeln!(out, "{STAMP_COLUMNS},marks,mark,angle_deg,{range},peak,weight,first_beam,last_beam,edge")
    }

    /// Writes the rows of `marks`. Column `marks` is the number of marks, or empty if marks are unavailable. If there
    /// are no marks, the columns after `marks` are empty.
    ///
    /// # Errors
    ///
    /// Returns the error of `out`.
    pub fn write_rows(self, out: &mut impl Write, header: &Header, marks: &Marks) -> io::Result<()> {
        for (number, mark) in marks.marks().iter().enumerate() {
            write_stamps(out, header)?;
            let (count, angle_deg) = (marks.marks().len(), f64::from(mark.angle_mdeg) / 1000.0);
            let range = f64::from(mark.range_dmm) / if self.meters { 10_000.0 } else { 10.0 };
            write!(out, ",{count},{number},{angle_deg},{range},{},{}", mark.peak, mark.weight)?;
            writeln!(out, ",{},{},{}", mark.first_beam, mark.last_beam, mark.edge)?;
        }
        if marks.marks().is_empty() {
            write_stamps(out, header)?;
            let count = if marks.is_available() { "0" } else { "" };
            writeln!(out, ",{count},,,,,,,,")?;
        }
        Ok(())
    }
}

fn write_stamps(line: &mut impl Write, header: &Header) -> io::Result<()> {
    let (stamp_ns, wall_ns) = (header.stamp_first_ns, header.wall_ns);
    write!(line, "{},{},{stamp_ns},{wall_ns},{}", header.seq, header.topic_seq, header.quality().name())
}

const STAMP_COLUMNS: &str = "seq,topic_seq,stamp_ns,wall_ns,quality";
const UM_PER_M: u32 = 1_000_000;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ArrayFlags, Mark, ScanHead};

    fn text(write: impl FnOnce(&mut Vec<u8>) -> io::Result<()>) -> String {
        let mut line = Vec::new();
        write(&mut line).unwrap();
        String::from_utf8(line).unwrap()
    }

    #[test]
    fn scan_row_has_optional_meters_and_intensities() {
        let head = ScanHead {
            unit_um: 250,
            contents: ArrayFlags::UPPER,
            intensity_bits: 8,
            valid_to: 39_999,
            ..ScanHead::default()
        };
        let mut scan = Scan::of(head, &[1, 40_000, 12_345]);
        scan.arrays().upper.copy_from_slice(&[7, 0, 255]);
        let (header, plain) = (Header { seq: 5, ..Header::default() }, ScanColumns::default());
        let all = ScanColumns { meters: true, intensities: true };
        let begin =
            "seq,topic_seq,stamp_ns,wall_ns,quality,unit_um,first_angle_deg,step_deg,range_0,range_1,range_2";
        assert_eq!(text(|line| plain.write_header(line, 3)), begin);
        assert_eq!(
            text(|line| all.write_header(line, 3)),
            format!("{begin},intensity_0,intensity_1,intensity_2")
        );
        assert_eq!(text(|line| plain.write_row(line, &header, &scan)), "5,0,0,0,clean,250,0,0,1,,12345");
        assert_eq!(
            text(|line| all.write_row(line, &header, &scan)),
            "5,0,0,0,clean,1000000,0,0,0.00025,,3.08625,7,0,255"
        );
        scan.intensity_bits = 0;
        let empty = text(|line| ScanColumns { intensities: true, ..plain }.write_row(line, &header, &scan));
        assert_eq!(empty, "5,0,0,0,clean,250,0,0,1,,12345,,,");
    }

    #[test]
    fn csv_has_a_row_for_each_mark() {
        let mut marks = Marks { count: 2, ..Marks::default() };
        marks.mark_array[1] = Mark {
            angle_mdeg: -90_500,
            range_dmm: 12_345,
            weight: 17,
            peak: 9,
            edge: 1,
            first_beam: 0,
            last_beam: 2,
        };
        let header = Header { seq: 5, ..Header::default() };
        let rows = |meters, marks: &Marks| text(|out| MarkColumns { meters }.write_rows(out, &header, marks));
        let first = "5,0,0,0,clean,2,0,0,0,0,0,0,0,0\n";
        assert_eq!(rows(false, &marks), format!("{first}5,0,0,0,clean,2,1,-90.5,1234.5,9,17,0,2,1\n"));
        assert!(rows(true, &marks).ends_with(",2,1,-90.5,1.2345,9,17,0,2,1\n"));
        assert_eq!(rows(false, &Marks::default()), "5,0,0,0,clean,0,,,,,,,,\n");
        let unavailable = Marks { flags: Marks::UNAVAILABLE, ..Marks::default() };
        assert_eq!(rows(false, &unavailable), "5,0,0,0,clean,,,,,,,,,\n");
        let columns = |row: &str| row.trim_end().split(',').count();
        assert_eq!(
            columns(&rows(false, &unavailable)),
            columns(&text(|out| MarkColumns::default().write_header(out)))
        );
    }
}

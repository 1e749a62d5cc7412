//! Writes scans for other programs, as messages of ROS 2 and as CSV, and recorded marks as CSV.

use std::io::{self, Write};

use ros::bag::{self, Bag};
use schema::csv::{MarkColumns, ScanColumns};
use schema::datagram::Packed;
use schema::file::{Compression, Writer};
use schema::{Failure, Kind, Marks, Topic};

use super::output::Packing;
use super::scans::Sight;
use super::{CHUNK, Written};
use crate::mcap::Item;
use crate::{Form, Recording};

/// A format that scans are written in.
pub(super) trait View {
    /// Writes a part of a recording. Returns what became of it; `None` if it was not a telegram.
    fn see(&mut self, sight: &Sight<'_>) -> io::Result<Option<Written>>;

    /// Returns whether intensities were requested, and no scan had any.
    fn lacks_intensities(&self) -> bool {
        false
    }

    /// Writes the end.
    fn finish(self) -> io::Result<()>;
}

/// An MCAP file with only messages of ROS 2.
pub(super) struct Ros2<W: Write> {
    writer: Writer<W>,
    bag: Bag,
    /// Whether each scan is also written as points.
    has_points: bool,
    /// Bytes of scans in the open chunk, approximately.
    chunk_len: usize,
}

impl<W: Write> Ros2<W> {
    pub(super) fn begin(file: W, compression: Compression, from: &str, has_points: bool) -> io::Result<Self> {
        let facts = [("converted from".to_owned(), from.to_owned())];
        Ok(Ros2 {
            writer: Writer::packed(file, bag::PROFILE, compression, facts.into())?,
            bag: Bag::default(),
            has_points,
            chunk_len: 0,
        })
    }
}

impl<W: Write> View for Ros2<W> {
    fn see(&mut self, sight: &Sight<'_>) -> io::Result<Option<Written>> {
        match sight {
            Sight::Scan(sensor, header, scan) => {
                self.bag.scan(&mut self.writer, sensor, header, scan)?;
                self.chunk_len += scan.beams() * size_of::<f32>();
                if self.has_points {
                    self.bag.points(&mut self.writer, sensor, header, scan)?;
                    self.chunk_len += scan.beams() * size_of::<[f32; 4]>();
                }
                if self.chunk_len >= CHUNK {
                    self.writer.close_chunk()?;
                    self.chunk_len = 0;
                }
                Ok(Some(Written::Scan))
            }
            Sight::Pose(sensor, wall_ns, pose) => {
                self.bag.pose(&mut self.writer, sensor, *wall_ns, pose)?;
                Ok(None)
            }
            Sight::Other => Ok(Some(Written::LeftOut)),
        }
    }

    fn finish(self) -> io::Result<()> {
        self.writer.finish().map(drop)
    }
}

/// A row for each scan, after the names of the columns. The names are repeated if the number of beams changes.
pub(super) struct Csv<W: Write> {
    out: Packing<W>,
    columns: ScanColumns,
    /// Number of beams in the last line of column names.
    beams: Option<usize>,
    has_intensities: bool,
    line: Vec<u8>,
}

impl<W: Write> Csv<W> {
    pub(super) fn begin(out: Packing<W>, columns: ScanColumns) -> Self {
        Csv { out, columns, beams: None, has_intensities: false, line: Vec::new() }
    }
}

impl<W: Write> View for Csv<W> {
    fn see(&mut self, sight: &Sight<'_>) -> io::Result<Option<Written>> {
        let Sight::Scan(_, header, scan) = sight else {
            return Ok(matches!(sight, Sight::Other).then_some(Written::LeftOut));
        };
        self.line.clear();
        if self.beams != Some(scan.beams()) {
            self.beams = Some(scan.beams());
            self.columns.names(&mut self.line, scan.beams())?;
            self.line.push(b'\n');
        }
        self.has_intensities |= !scan.intensities().is_empty();
        self.columns.row(&mut self.line, header, scan)?;
        self.line.push(b'\n');
        self.out.write_all(&self.line)?;
        Ok(Some(Written::Scan))
    }

    fn lacks_intensities(&self) -> bool {
        self.columns.intensities && !self.has_intensities
    }

    fn finish(self) -> io::Result<()> {
        self.out.finish()
    }
}

/// Writes the marks of the chosen sensor of `recording`, and returns their number.
///
/// # Errors
///
/// Returns [`Kind::NoTopic`] if none were recorded. Otherwise the error of `count`, or of the output as `failed` makes it.
pub(super) fn write_marks(
    recording: &Recording,
    columns: MarkColumns,
    mut out: Packing<impl Write>,
    count: &mut impl FnMut(Written, Option<u64>) -> Result<(), Failure>,
    failed: &impl Fn(io::Error) -> Failure,
) -> Result<u64, Failure> {
    let mut lines = Vec::new();
    columns.names(&mut lines).map_err(failed)?;
    let (mut samples, mut written) = (0, 0);
    if recording.contents().form == Form::Mcap {
        let (mut reader, catalog) = recording.reader()?;
        while let Some(item) = reader.next().map_err(|error| recording.broken(&error))? {
            let Item::Record(record) = item else { continue };
            let Some((place, header, payload)) = catalog.message(&record) else { continue };
            let mut marks = Marks::default();
            if place.topic != Topic::Marks
                || recording.chosen() != Some(&place.sensor)
                || !marks.unpack(payload)
            {
                continue;
            }
            columns.rows(&mut lines, &header, &marks).map_err(failed)?;
            out.write_all(&lines).map_err(failed)?;
            lines.clear();
            samples += 1;
            written += marks.marks().len() as u64;
            count(Written::Marks, Some(header.wall_ns))?;
        }
    }
    if samples == 0 {
        let path = recording.path().display();
        let message = format!("there are no recorded marks in {path}");
        let hint = format!(
            "`scanhub replay {path}` finds marks in the scans, and meanwhile `scanhub record SENSOR/marks` records them"
        );
        return Err(Failure::new(Kind::NoTopic, message, hint));
    }
    out.finish().map_err(failed)?;
    Ok(written)
}

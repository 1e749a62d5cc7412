//! Writes scans for other programs: as messages of ROS 2, and as lines of CSV.

use std::io::{self, Write};

use ros::bag::{self, Bag};
use schema::csv::ScanColumns;
use schema::file::{Compression, Writer};

use super::decoded::Sight;
use super::{CHUNK, Packing, Written};

/// Something that scans are written into.
pub(super) trait View {
    /// Writes what was seen; answers what became of it, unless it was no telegram.
    fn see(&mut self, sight: &Sight<'_>) -> io::Result<Option<Written>>;

    /// Returns whether intensities were requested, and no scan had any.
    fn lacks_intensities(&self) -> bool {
        false
    }

    /// Writes the end.
    fn finish(self) -> io::Result<()>;
}

/// An MCAP file of messages of ROS 2 alone.
pub(super) struct Ros2<W: Write> {
    writer: Writer<W>,
    bag: Bag,
    /// Beams since the last chunk.
    beams: usize,
}

impl<W: Write> Ros2<W> {
    pub(super) fn begin(file: W, compression: Compression, from: &str) -> io::Result<Self> {
        let facts = [("converted from".to_owned(), from.to_owned())];
        Ok(Ros2 {
            writer: Writer::packed(file, bag::PROFILE, compression, facts.into())?,
            bag: Bag::default(),
            beams: 0,
        })
    }
}

impl<W: Write> View for Ros2<W> {
    fn see(&mut self, sight: &Sight<'_>) -> io::Result<Option<Written>> {
        match sight {
            Sight::Scan(sensor, header, scan) => {
                self.bag.scan(&mut self.writer, sensor, header, scan)?;
                self.beams += scan.beams();
                if self.beams * size_of::<f32>() >= CHUNK {
                    self.writer.close_chunk()?;
                    self.beams = 0;
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

/// A row for each scan, below the names of the columns, which come again if their number changes.
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

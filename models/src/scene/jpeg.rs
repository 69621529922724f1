//! Whether all of a JPEG image is there: its scans hold as many blocks as its header promises, each ending at a marker.
//!
//! Decoders paint what is missing or garbled grey. Nothing is decoded here; Huffman codes are only followed, through
//! baseline and progressive scans (ITU T.81, annexes F and G). What it does not know it leaves to the decoder.

/// A code's length and its symbol, by the next 16 bits; length 0 where there is no such code.
type Huffman = Vec<(u8, u8)>;

struct Component {
    id: u8,
    across: usize,
    down: usize,
    /// Blocks in a row of a scan of its own, and rows.
    blocks: [usize; 2],
    /// Blocks in a row, whole units of the image; the coefficients of each that are not zero so far, a bit each.
    stride: usize,
    known: Vec<u64>,
}

#[derive(Default)]
struct Frame {
    components: Vec<Component>,
    /// Units of an interleaved scan.
    units: [usize; 2],
    progressive: bool,
}

/// What of a scan concerns all of its blocks: first and last coefficient, whether bits are added to known ones.
#[derive(Clone, Copy)]
struct Band {
    start: usize,
    end: usize,
    refines: bool,
    progressive: bool,
}

/// What is wrong with an image, if it is of this format.
pub(crate) fn damage(bytes: &[u8]) -> Option<String> {
    if !bytes.starts_with(&[0xff, 0xd8]) {
        return None;
    }
    Reader { bytes, at: 2, ..Reader::default() }.image().err()
}

fn ended() -> String {
    "the file ends in the middle of the image".to_string()
}

/// A file, and the bits of the scan that is being read.
#[derive(Default)]
struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
    bits: u32,
    count: u32,
    /// Bits that were made up after the end of the scan.
    lacking: u32,
    /// Blocks to come that have no further coefficients in this band.
    empty: u32,
    dc: [Huffman; 4],
    ac: [Huffman; 4],
    restart: usize,
    frame: Frame,
}

impl Reader<'_> {
    fn image(&mut self) -> Result<(), String> {
        let mut scans = 0;
        loop {
            let marker = self.marker()?;
            if marker == 0xd9 {
                return if scans > 0 { Ok(()) } else { Err("it has no picture".to_string()) };
            }
            if matches!(marker, 0x01 | 0xd0..=0xd7) {
                continue;
            }
            let length = usize::from(self.bytes.get(self.at).copied().ok_or_else(ended)?) * 256
                + usize::from(self.bytes.get(self.at + 1).copied().ok_or_else(ended)?);
            let segment = self.bytes.get(self.at + 2..self.at + length).ok_or_else(ended)?;
            self.at += length;
            match marker {
                0xc4 => self.tables(segment).ok_or("its Huffman tables are garbled")?,
                0xdd => self.restart = segment.get(..2).map_or(0, |n| usize::from(n[0]) * 256 + usize::from(n[1])),
                0xc0..=0xc2 => self.frame = Frame::of(segment, marker == 0xc2).ok_or("its header is garbled")?,
                // Arithmetic codes and the like.
                0xc3 | 0xc5..=0xcf => return Ok(()),
                0xda => {
                    self.scan(segment)?;
                    scans += 1;
                }
                _ => {}
            }
        }
    }

    /// The marker that comes next.
    fn marker(&mut self) -> Result<u8, String> {
        // Any number of these may come first.
        while self.bytes.get(self.at..self.at + 2) == Some(&[0xff, 0xff]) {
            self.at += 1;
        }
        match self.bytes.get(self.at..).unwrap_or_default() {
            [0xff, marker, ..] => {
                self.at += 2;
                Ok(*marker)
            }
            [] | [0xff] => Err(ended()),
            _ => Err(format!("byte {} is no part of the image", self.at)),
        }
    }

    fn tables(&mut self, mut segment: &[u8]) -> Option<()> {
        while let Some((&kind, rest)) = segment.split_first() {
            let (counts, symbols) = rest.split_first_chunk::<16>()?;
            let total = counts.iter().map(|n| usize::from(*n)).sum();
            let (symbols, rest) = symbols.split_at_checked(total)?;
            let lengths = (1u8..).zip(counts).flat_map(|(length, n)| std::iter::repeat_n(length, usize::from(*n)));
            let mut table = vec![];
            for (length, symbol) in lengths.zip(symbols) {
                table.extend(std::iter::repeat_n((length, *symbol), 1 << (16 - length)));
            }
            (table.len() <= 1 << 16).then_some(())?;
            table.resize(1 << 16, (0, 0));
            let tables = if kind >> 4 == 0 { &mut self.dc } else { &mut self.ac };
            *tables.get_mut(usize::from(kind & 15))? = table;
            segment = rest;
        }
        Some(())
    }

    fn scan(&mut self, header: &[u8]) -> Result<(), String> {
        let garbled = "the header of a scan is garbled";
        let (count, rest) = header.split_first().ok_or(garbled)?;
        let (chosen, band) = rest.split_at_checked(2 * usize::from(*count)).ok_or(garbled)?;
        let &[start, end, bits] = band else { return Err(garbled.into()) };
        let mut frame = std::mem::take(&mut self.frame);
        let mut parts = vec![];
        for &[id, tables] in chosen.as_chunks::<2>().0 {
            let which = frame.components.iter().position(|c| c.id == id).ok_or(garbled)?;
            let (dc, ac) = (usize::from(tables >> 4), usize::from(tables & 15));
            parts.push((which, dc.min(3), ac.min(3)));
        }
        let progressive = frame.progressive;
        let (start, end) = if progressive { (usize::from(start), usize::from(end)) } else { (0, 63) };
        let band = Band { start, end, refines: progressive && bits >> 4 > 0, progressive };
        if parts.is_empty() || start > end || end > 63 {
            return Err(garbled.into());
        }
        (self.bits, self.count, self.lacking, self.empty) = (0, 0, 0, 0);
        let alone = parts.len() == 1;
        let [across, down] = if alone { frame.components[parts[0].0].blocks } else { frame.units };
        for unit in 0..across * down {
            if self.restart > 0 && unit > 0 && unit % self.restart == 0 {
                self.rest()?;
                let expected = 0xd0 + ((unit / self.restart - 1) % 8) as u8;
                if self.marker()? != expected {
                    return Err(format!("a restart marker is missing before byte {}", self.at));
                }
            }
            let (row, column) = (unit / across, unit % across);
            for (which, dc, ac) in &parts {
                let c = &mut frame.components[*which];
                let [wide, high] = if alone { [1, 1] } else { [c.across, c.down] };
                for k in 0..wide * high {
                    let place = (row * high + k / wide) * c.stride + column * wide + k % wide;
                    self.block(&mut c.known[place], band, *dc, *ac)
                        .filter(|()| self.lacking == 0)
                        .ok_or_else(|| format!("its picture is cut or garbled before byte {}", self.at))?;
                }
            }
        }
        self.frame = frame;
        self.rest()
    }

    /// The end of an interval: less than a byte is left before a marker.
    fn rest(&mut self) -> Result<(), String> {
        let left = self.count / 8;
        (self.bits, self.count, self.empty) = (0, 0, 0);
        match (left, self.bytes.get(self.at..self.at + 2)) {
            (0, Some([0xff, 1..=255])) => Ok(()),
            (0, None | Some([])) => Err(ended()),
            _ => Err(format!("its picture is garbled before byte {}", self.at)),
        }
    }

    /// At least 16 bits ahead, made up past a marker.
    fn fill(&mut self) {
        while self.count < 16 {
            let byte = match self.bytes.get(self.at..).unwrap_or_default() {
                [0xff, 0, ..] => {
                    self.at += 2;
                    0xff
                }
                [byte, ..] if *byte != 0xff => {
                    self.at += 1;
                    *byte
                }
                _ => {
                    self.lacking += 8;
                    0
                }
            };
            self.bits = self.bits << 8 | u32::from(byte);
            self.count += 8;
        }
    }

    fn take(&mut self, n: u32) -> u32 {
        self.fill();
        self.count -= n;
        (self.bits >> self.count) & ((1 << n) - 1)
    }

    fn symbol(&mut self, dc: bool, table: usize) -> Option<u8> {
        self.fill();
        let ahead = (self.bits >> (self.count - 16)) & 0xffff;
        let tables = if dc { &self.dc } else { &self.ac };
        let (length, symbol) = *tables[table].get(ahead as usize)?;
        self.count -= u32::from(length);
        (length > 0).then_some(symbol)
    }

    /// Follows the codes of a block; `None` where they are none.
    fn block(&mut self, known: &mut u64, band: Band, dc: usize, ac: usize) -> Option<()> {
        self.coefficients(known, band, dc, ac)?;
        // Bits that were made up and not used are not missing.
        let unused = self.lacking.min(self.count);
        (self.lacking, self.count, self.bits) = (self.lacking - unused, self.count - unused, self.bits >> unused);
        Some(())
    }

    fn coefficients(&mut self, known: &mut u64, band: Band, dc: usize, ac: usize) -> Option<()> {
        let mut k = band.start;
        if k == 0 {
            if band.refines {
                self.take(1);
            } else {
                let size = u32::from(self.symbol(true, dc)?);
                (size <= 16).then(|| self.take(size))?;
            }
            k = 1;
            if band.progressive {
                return Some(());
            }
        }
        if self.empty > 0 {
            self.empty -= 1;
            self.corrections(*known, k, band, None);
            return Some(());
        }
        while k <= band.end {
            let symbol = self.symbol(false, ac)?;
            let (run, size) = (u32::from(symbol >> 4), u32::from(symbol & 15));
            if size == 0 && run < 15 {
                self.empty = if band.progressive { (1 << run) - 1 + self.take(run) } else { 0 };
                (band.progressive || run == 0).then_some(())?;
                self.corrections(*known, k, band, None);
                return Some(());
            }
            self.take(size);
            k = match band.refines {
                true => self.corrections(*known, k, band, Some(run)),
                false => k + run as usize,
            };
            // A run of 16 zeros may end with the band.
            (k <= band.end).then_some(())?;
            *known |= u64::from(size > 0) << k;
            k += 1;
        }
        Some(())
    }

    /// A bit for each known coefficient from `k` on, up to the one after `run` unknown ones; where that is.
    fn corrections(&mut self, known: u64, mut k: usize, band: Band, run: Option<u32>) -> usize {
        let mut left = run;
        while band.refines && k <= band.end {
            if known >> k & 1 == 1 {
                self.take(1);
            } else if left == Some(0) {
                break;
            } else {
                left = left.map(|n| n - 1);
            }
            k += 1;
        }
        k
    }
}

impl Frame {
    fn of(segment: &[u8], progressive: bool) -> Option<Frame> {
        let &[_, h1, h0, w1, w0, _, ref rest @ ..] = segment else { return None };
        let [height, width] = [[h1, h0], [w1, w0]].map(|pair| usize::from(u16::from_be_bytes(pair)));
        let parts = rest.as_chunks::<3>().0;
        let factors = |p: &[u8; 3]| [usize::from(p[1] >> 4), usize::from(p[1] & 15)];
        let most = |axis: usize| parts.iter().map(|p| factors(p)[axis]).max();
        let (across, down) = (most(0)?, most(1)?);
        let units = [width.div_ceil(8 * across.max(1)), height.div_ceil(8 * down.max(1))];
        let component = |p: &[u8; 3]| {
            let [a, d] = factors(p);
            ((1..=4).contains(&a) && (1..=4).contains(&d)).then_some(())?;
            let blocks = [(width * a).div_ceil(across).div_ceil(8), (height * d).div_ceil(down).div_ceil(8)];
            let stride = units[0] * a;
            Some(Component { id: p[0], across: a, down: d, blocks, stride, known: vec![0; stride * units[1] * d] })
        };
        Some(Frame { components: parts.iter().map(component).collect::<Option<_>>()?, units, progressive })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use base64::Engine;
    use image::codecs::jpeg::JpegEncoder;
    use image::{Rgb, RgbImage};

    fn photo() -> Vec<u8> {
        let mut random = 7u32;
        let image = RgbImage::from_fn(130, 97, |x, y| {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            Rgb([x as u8, (y * 2) as u8, (random >> 26) as u8 + 3 * (x % 40) as u8])
        });
        let mut bytes = vec![];
        image.write_with_encoder(JpegEncoder::new_with_quality(&mut bytes, 90)).unwrap();
        bytes
    }

    #[test]
    fn whole_images_and_cut_ones() {
        let whole = photo();
        assert_eq!(damage(&whole), None);
        // Phones append pictures and films.
        assert_eq!(damage(&[&whole[..], b"\xff\xd8 more"].concat()), None);
        for percent in [30, 60, 90] {
            let cut = &whole[..whole.len() * percent / 100];
            assert!(damage(cut).is_some(), "{percent} %");
            assert!(damage(&[cut, &[0xff, 0xd9]].concat()).is_some(), "{percent} %, with an end");
        }
        assert!(damage(&[&whole[..700], &vec![0xff; 1 << 20]].concat()).is_some());
        let mut zeroed = whole.clone();
        zeroed[whole.len() / 2..][..2000].fill(0);
        assert!(damage(&zeroed).is_some());
    }

    #[test]
    fn every_place_of_a_cut() {
        let whole = photo();
        assert!((2..whole.len()).all(|n| damage(&whole[..n]).is_some()));
    }

    /// 20 x 12 pixels, colours at half the resolution, in the ten scans that libjpeg makes by default.
    const PROGRESSIVE: &str = "\
        /9j/4AAQSkZJRgABAQAAAQABAAD/2wBDAAoHBwgHBgoICAgLCgoLDhgQDg0NDh0VFhEYIx8lJCIfIiEmKzcvJik0KSEiMEExNDk7Pj4+JS5ESUM8\
        SDc9Pjv/2wBDAQoLCw4NDhwQEBw7KCIoOzs7Ozs7Ozs7Ozs7Ozs7Ozs7Ozs7Ozs7Ozs7Ozs7Ozs7Ozs7Ozs7Ozs7Ozs7Ozs7Ozv/wgARCAAMABQD\
        ASIAAhEBAxEB/8QAFwAAAwEAAAAAAAAAAAAAAAAAAAQFBv/EABYBAQEBAAAAAAAAAAAAAAAAAAQCBf/aAAwDAQACEAMQAAABiPVHIPINCG2v/8QA\
        GRAAAwEBAQAAAAAAAAAAAAAAAAECBBEU/9oACAEBAAEFAozE5zzkQuTCFCP/xAAYEQADAQEAAAAAAAAAAAAAAAAAAgQBEf/aAAgBAwEBPwGatjK2\
        4f/EABkRAAIDAQAAAAAAAAAAAAAAAAABAgMhE//aAAgBAgEBPwHslFYSt0//xAAWEAEBAQAAAAAAAAAAAAAAAAAAMSD/2gAIAQEABj8CRMf/xAAY\
        EAADAQEAAAAAAAAAAAAAAAAAAREhMf/aAAgBAQABPyGyrQkxFBDwduDa4f/aAAwDAQACAAMAAAAQgN//xAAWEQEBAQAAAAAAAAAAAAAAAAAAARH/\
        2gAIAQMBAT8QvrMf/8QAGBEAAwEBAAAAAAAAAAAAAAAAAAERMcH/2gAIAQIBAT8Qadqco1tD/8QAHRABAAICAgMAAAAAAAAAAAAAAQARIUExYVGB\
        8f/aAAgBAQABPxAsADdTFodWZfUGQarR9gfDFrsmQWqpk3BTU//Z";

    #[test]
    fn progressive_images() {
        let whole = base64::engine::general_purpose::STANDARD.decode(PROGRESSIVE).unwrap();
        assert_eq!(damage(&whole), None);
        assert!((2..whole.len()).all(|n| damage(&whole[..n]).is_some()));
        // Scans that lack their last byte.
        let scans = (1..whole.len() - 1).filter(|i| whole[*i..][..2] == [0xff, 0xda]).skip(1);
        let short: Vec<bool> = scans
            .filter_map(|at| (1..at).rev().find(|i| whole[i - 1] != 0xff && whole[*i] == 0xff && whole[i + 1] == 0xc4))
            .map(|at| damage(&[&whole[..at - 1], &whole[at..]].concat()).is_some())
            .collect();
        assert!(short.len() > 3 && short.iter().all(|refused| *refused), "{short:?}");
    }
}

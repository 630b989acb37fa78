//! Follows a finger in grey frames, and draws the way of its tip, the contour and the finger line.
//!
//! ```text
//! follow [--size WxH] [--fps N] [--start U,V,DEGREES,LENGTH] [FRAME.pgm ...] > follow.svg
//! ```
//!
//! Frames are PGM files, or come from standard input: PGM pictures one after the other, or raw grey
//! pixels with `--size`, as `ffmpeg -f rawvideo -pix_fmt gray -` writes them. Without `--start` the
//! finger is found: candidates are followed side by side, and the best contour is kept.

use fingerpost_core::nalgebra::{Point2, Vector2};
use fingerpost_core::{ContourTracker, FinderOptions, FingerLine, Frame, GrayView, HandFinder};
use fingerpost_core::{Proportions, StartPose, Status, Template, Thumb, TrackerOptions};
use std::env;
use std::error::Error;
use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Write as _};

type Any<T> = Result<T, Box<dyn Error>>;

/// Candidates that are followed side by side, and for how many frames until one is chosen.
const CANDIDATES: usize = 12;
const TRIAL_FRAMES: usize = 8;

fn main() {
    if let Err(error) = run() {
        let _ = writeln!(io::stderr(), "follow: {error}");
        std::process::exit(2);
    }
}

fn run() -> Any<()> {
    let Arguments { size, fps, start, files } = Arguments::read(env::args().skip(1))?;
    let mut inputs: Vec<Box<dyn BufRead>> = Vec::new();
    for name in &files {
        let file = File::open(name).map_err(|error| format!("{name}: {error}"))?;
        inputs.push(Box::new(BufReader::new(file)));
    }
    if files.is_empty() {
        inputs.push(Box::new(io::stdin().lock()));
    }
    let (picture, follower) = follow(inputs, size, fps, start)?;
    let (frames, lines) = (follower.frames, follower.lines.len());
    writeln!(io::stderr(), "{frames} frames, {lines} with a finger line")?;
    io::stdout().write_all(drawing(&picture, &follower)?.as_bytes())?;
    Ok(())
}

/// Follows the finger through all pictures; returns the last one with what was followed.
fn follow(
    inputs: Vec<Box<dyn BufRead + '_>>,
    size: Option<(usize, usize)>,
    fps: f64,
    start: Option<StartPose>,
) -> Any<(Picture, Follower)> {
    let mut follower = Follower::new(start)?;
    let mut last = None;
    for mut input in inputs {
        while let Some(picture) = Picture::read(&mut input, size)? {
            follower.take(&picture, fps)?;
            last = Some(picture);
        }
    }
    let picture = last.ok_or("no frames: name PGM files, or send frames to standard input")?;
    Ok((picture, follower))
}

struct Arguments {
    size: Option<(usize, usize)>,
    fps: f64,
    start: Option<StartPose>,
    files: Vec<String>,
}

impl Arguments {
    fn read(mut arguments: impl Iterator<Item = String>) -> Any<Self> {
        let mut read = Self { size: None, fps: 30.0, start: None, files: Vec::new() };
        while let Some(argument) = arguments.next() {
            let mut value = || arguments.next().ok_or(format!("{argument}: a value is missing"));
            match argument.as_str() {
                "--size" => {
                    let size = value()?;
                    let (width, height) = size.split_once('x').ok_or("--size: not like 640x480")?;
                    read.size = Some((width.parse()?, height.parse()?));
                }
                "--fps" => read.fps = value()?.parse()?,
                "--start" => {
                    let numbers: Vec<f64> =
                        value()?.split(',').map(str::parse).collect::<Result<_, _>>()?;
                    let [u, v, angle_deg, length_px] = numbers[..] else {
                        return Err("--start: not like 195,212,44,71".into());
                    };
                    let (tip_px, angle_rad) = (Point2::new(u, v), angle_deg.to_radians());
                    read.start = Some(StartPose { tip_px, angle_rad, length_px });
                }
                option if option.starts_with('-') => {
                    return Err(format!("{option}: there are --size, --fps and --start").into());
                }
                _ => read.files.push(argument),
            }
        }
        Ok(read)
    }
}

/// A grey picture that owns its pixels.
struct Picture {
    width: usize,
    height: usize,
    pixels: Vec<u8>,
}

impl Picture {
    /// The next picture; `None` at the end. A last one that was cut off is left out.
    fn read(input: &mut dyn BufRead, size: Option<(usize, usize)>) -> Any<Option<Self>> {
        let (width, height) = match size {
            Some(size) => size,
            None if input.fill_buf()?.is_empty() => return Ok(None),
            None => Self::read_header(input)?,
        };
        let mut pixels = vec![0; width.checked_mul(height).ok_or("too large a picture")?];
        match input.read_exact(&mut pixels) {
            Ok(()) => Ok(Some(Self { width, height, pixels })),
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// The size that stands in the header of a binary PGM with a byte a pixel.
    fn read_header(input: &mut dyn BufRead) -> Any<(usize, usize)> {
        let words: Vec<_> = (0..4).map(|_| header_word(input)).collect::<Result<_, _>>()?;
        match [words[0].as_str(), words[3].as_str()] {
            ["P5", "255"] => Ok((words[1].parse()?, words[2].parse()?)),
            _ => Err("not a binary PGM of 255 levels; raw pixels need --size WIDTHxHEIGHT".into()),
        }
    }

    fn frame(&self) -> fingerpost_core::Result<Frame<'_>> {
        Ok(Frame::gray(GrayView::new(&self.pixels, self.width, self.height, self.width)?))
    }
}

/// A word of a PGM's header with the one blank that ends it; comments are skipped.
fn header_word(input: &mut dyn BufRead) -> Any<String> {
    let mut word = String::new();
    loop {
        let mut byte = [0];
        input.read_exact(&mut byte).map_err(|_| "a PGM that ends in its header")?;
        match byte[0] {
            b'#' => {
                input.read_until(b'\n', &mut Vec::new())?;
            }
            byte if !byte.is_ascii_whitespace() && word.len() < 16 => word.push(char::from(byte)),
            _ if word.is_empty() => {}
            _ => return Ok(word),
        }
    }
}

/// One hand, and the candidates for it until it is known.
struct Follower {
    finder: HandFinder,
    trials: Vec<ContourTracker>,
    agreement: Vec<f64>,
    trial_frames: usize,
    followed: Option<ContourTracker>,
    frames: u32,
    lines: Vec<FingerLine>,
}

impl Follower {
    fn new(start: Option<StartPose>) -> Any<Self> {
        let mut follower = Self {
            finder: HandFinder::new(FinderOptions::default())?,
            trials: Vec::new(),
            agreement: Vec::new(),
            trial_frames: 0,
            followed: None,
            frames: 0,
            lines: Vec::new(),
        };
        if let Some(start) = start {
            let template = Template::pistol(Thumb::None)?;
            let tracker = ContourTracker::new(template, &start, TrackerOptions::default())?;
            follower.followed = Some(tracker);
        }
        Ok(follower)
    }

    fn take(&mut self, picture: &Picture, fps: f64) -> Any<()> {
        let (frame, time_s) = (picture.frame()?, f64::from(self.frames) / fps);
        self.frames += 1;
        if let Some(tracker) = &mut self.followed {
            self.lines.extend(tracker.update(&frame, time_s)?.finger_line);
            return Ok(());
        }
        if self.trials.is_empty() {
            self.find(&frame)?;
        }
        for (tracker, agreement) in self.trials.iter_mut().zip(&mut self.agreement) {
            *agreement += tracker.update(&frame, time_s)?.diagnostics.agreement;
        }
        self.trial_frames += 1;
        if self.trial_frames == TRIAL_FRAMES {
            let trials = self.trials.drain(..).zip(self.agreement.drain(..));
            let tracked = trials.filter(|(tracker, _)| tracker.status() == Status::Tracking);
            self.followed = tracked.max_by(|a, b| a.1.total_cmp(&b.1)).map(|(tracker, _)| tracker);
        }
        Ok(())
    }

    /// A tracker for each of the best candidates, with a template as wide as the candidate.
    fn find(&mut self, frame: &Frame<'_>) -> Any<()> {
        for candidate in self.finder.find(frame, None).iter().take(CANDIDATES) {
            let length_px =
                candidate.half_width_px / Proportions::usual(candidate.thumb).half_width;
            let (tip_px, angle_rad) = (candidate.tip_px, candidate.angle_rad);
            let start = StartPose { tip_px, angle_rad, length_px };
            let template = Template::pistol(candidate.thumb)?;
            self.trials.push(ContourTracker::at_hand(template, &start, TrackerOptions::default())?);
        }
        self.agreement = vec![0.0; self.trials.len()];
        self.trial_frames = 0;
        Ok(())
    }
}

/// The last frame, and over it the way of the tip, the contour, the edges and the finger line.
fn drawing(picture: &Picture, follower: &Follower) -> Any<String> {
    let Picture { width, height, .. } = picture;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"-0.5 -0.5 {width} {height}\" fill=\"none\">\n\
         <image x=\"-0.5\" y=\"-0.5\" width=\"{width}\" height=\"{height}\" \
         href=\"data:image/bmp;base64,{}\"/>\n",
        base64(&bitmap(picture)),
    );
    let way = follower.lines.iter().map(|line| line.axis.tip);
    writeln!(svg, "{}", polyline(way, "#ffb000", 1.5))?;
    if let Some(tracker) = &follower.followed {
        let contour = tracker.contour().into_iter().map(|sample| sample.position);
        writeln!(svg, "{}", polyline(contour, "#00c8ff", 1.0))?;
        for searched in tracker.search_lines().filter(|searched| searched.agrees) {
            let Ok(edge) = searched.found else { continue };
            let sample = searched.line.sample;
            let at = sample.position + sample.normal * edge.offset_px;
            writeln!(
                svg,
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"1\" fill=\"#7cff4f\"/>",
                at.x, at.y
            )?;
        }
    }
    if let Some(FingerLine { axis, .. }) = follower.lines.last() {
        let far: Vector2<f64> = axis.direction() * (width + height) as f64;
        writeln!(svg, "{}", polyline([axis.anchor, axis.tip + far], "#ff3b6b", 1.2))?;
    }
    svg.push_str("</svg>\n");
    Ok(svg)
}

fn polyline(points: impl IntoIterator<Item = Point2<f64>>, colour: &str, width_px: f64) -> String {
    let points: Vec<_> = points.into_iter().map(|p| format!("{:.1},{:.1}", p.x, p.y)).collect();
    format!(
        "<polyline points=\"{}\" stroke=\"{colour}\" stroke-width=\"{width_px}\"/>",
        points.join(" ")
    )
}

/// A Windows bitmap of 256 grey levels, which every viewer of SVG shows.
fn bitmap(picture: &Picture) -> Vec<u8> {
    const HEADERS: usize = 14 + 40;
    const PALETTE: usize = 4 * 256;
    let stride = picture.width.next_multiple_of(4);
    let size = HEADERS + PALETTE + stride * picture.height;
    let word = |value: usize| (value as u32).to_le_bytes();
    let mut file = b"BM".to_vec();
    // Size, reserved, place of the pixels; size of the header that follows, width, height.
    for value in [size, 0, HEADERS + PALETTE, 40, picture.width, picture.height] {
        file.extend(word(value));
    }
    file.extend([1, 0, 8, 0]); // planes, bits a pixel
    // Compression, size of the pixels, pixels a metre twice, colours, of which all matter.
    for value in [0, stride * picture.height, 2835, 2835, 256, 0] {
        file.extend(word(value));
    }
    file.extend((0..=255).flat_map(|level| [level, level, level, 0]));
    for row in picture.pixels.chunks(picture.width).rev() {
        file.extend(row);
        file.resize(file.len() + stride - picture.width, 0);
    }
    file
}

fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len() * 4 / 3 + 4);
    for part in bytes.chunks(3) {
        let byte = |k: usize| u32::from(part.get(k).copied().unwrap_or(0));
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for k in 0..4 {
            let digit = DIGITS[(bits >> (18 - 6 * k) & 63) as usize];
            text.push(if k <= part.len() { char::from(digit) } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (320, 240);
    const FRAMES: u32 = 20;

    fn tip(k: u32) -> Point2<f64> {
        Point2::new(180.0, 140.0) + Vector2::new(1.5, -1.0) * f64::from(k)
    }

    /// Pixels of a bright finger of 16 px that points to the lower right, one frame after the other.
    fn film(header: &str) -> Vec<u8> {
        let along = Vector2::new(0.6_f64.cos(), 0.6_f64.sin());
        let mut film = Vec::new();
        for k in 0..FRAMES {
            film.extend(header.as_bytes());
            film.extend((0..SIZE.0 * SIZE.1).map(|i| {
                let d = Point2::new((i % SIZE.0) as f64, (i / SIZE.0) as f64) - tip(k);
                let inside = 8.0 - (d - along * d.dot(&along).min(-8.0)).norm();
                (60.0 + 100.0 * (0.5 + 0.5 * inside).clamp(0.0, 1.0)) as u8
            }));
        }
        film
    }

    fn check(film: &[u8], size: Option<(usize, usize)>, start: Option<StartPose>) -> Any<()> {
        let (picture, follower) = follow(vec![Box::new(film)], size, 30.0, start)?;
        assert_eq!(follower.frames, FRAMES);
        let last = follower.lines.last().ok_or("no finger line")?;
        assert!((last.axis.tip - tip(FRAMES - 1)).norm() < 0.7, "{}", last.axis.tip);
        let svg = drawing(&picture, &follower)?;
        assert!(svg.contains("<circle") && svg.matches("<polyline").count() == 3);
        Ok(())
    }

    #[test]
    fn a_finger_is_found_in_pgm_pictures_that_follow_one_another() -> Any<()> {
        check(&film("P5 # grey\n320 240\n255\n"), None, None)
    }

    #[test]
    fn raw_frames_are_followed_from_a_start_and_a_frame_that_is_cut_off_is_left_out() -> Any<()> {
        let start = ["--start".to_owned(), "183,137,32,70".to_owned()];
        let start = Arguments::read(start.into_iter())?.start;
        let mut film = film("");
        film.extend([60; 1000]);
        check(&film, Some(SIZE), start)
    }

    #[test]
    fn what_is_no_picture_is_refused() {
        for film in ["", "x", "P2 1 1 255\n1", "P5 1 1 65535\n12"] {
            assert!(follow(vec![Box::new(film.as_bytes())], None, 30.0, None).is_err(), "{film}");
        }
    }

    #[test]
    fn base64_and_bitmap_are_as_their_formats_say() {
        assert_eq!(
            ["", "f", "fo", "foo"].map(|s| base64(s.as_bytes())),
            ["", "Zg==", "Zm8=", "Zm9v"]
        );
        let file = bitmap(&Picture { width: 3, height: 2, pixels: vec![1, 2, 3, 4, 5, 6] });
        assert_eq!(file[2..6], (file.len() as u32).to_le_bytes());
        assert_eq!(file[file.len() - 8..], [4, 5, 6, 0, 1, 2, 3, 0]); // rows from below, padded to 4
    }
}

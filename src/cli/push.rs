//! `wildcity push`.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::Context as _;

use crate::cli::limits;
use crate::cli::output;
use wildcity_client::{
    AllCells, CellSelection, ConnectOptions, HttpClient, NewPush, PreviewRequest, Push as Pushed,
    PushFile, PushFrame, PushReport, PushState,
};
use wildcity_twin::ingest;

use super::file_notes::DropBad;
use super::{packed_folder, progress};

/// Push trained scenes to a server, as a new version of a twin.
///
/// The files become one scene. It replaces the 64 m cells that its Gaussians lie in, all at once.
/// Running sessions keep their version until they switch to the new one. To continue an upload
/// after a lost connection, run the same command again.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Push {
    /// Scene files in the formats that `wildcity import` reads, and the files that they name. For a
    /// SOG, only its folder is needed, or only its meta.json or lod-meta.json.
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,

    /// Name of the twin; a twin that does not exist is made.
    #[arg(long, value_name = "NAME")]
    twin: String,

    #[command(flatten)]
    server: Server,

    /// Directions of the files' axes, as in `wildcity import` [default: those that a file records,
    /// or those with which the twin was imported; for a new twin identity]
    #[arg(long, value_name = "AXES", allow_hyphen_values = true)]
    axes: Option<String>,

    /// Metres per unit of the files [default: that with which the twin was imported; for a new twin
    /// 1]
    #[arg(long, value_name = "M")]
    scale: Option<f64>,

    /// The frame of the files, after --axes and --scale: `twin`, or `capture` for the axes and the
    /// unit with which the capture was imported, before `wildcity twin align` [default: twin]
    #[arg(long, value_enum, value_name = "FRAME", hide_possible_values = true)]
    frame: Option<FrameName>,

    /// `all`, or a cell to replace as X,Y; may be given again. Cell (i, j) is centred on (64 i, 64
    /// j) m. Gaussians in other cells are left out [default: the cells that the Gaussians lie in]
    #[arg(long, value_name = "CELL", allow_hyphen_values = true)]
    cells: Vec<String>,

    /// The version that the scenes were trained from; cells that changed since are not overwritten
    /// [default: the latest]
    #[arg(long, value_name = "VERSION")]
    base: Option<u64>,

    /// Record format of the stored Gaussians, as in `wildcity import` [default: as in the twin]
    #[arg(long)]
    record: Option<String>,

    /// Make no levels of detail.
    #[arg(long)]
    no_lod: bool,

    /// Change one field of the twin's render profile, as in `wildcity import`; may be given again.
    #[arg(long = "set", value_name = "FIELD=VALUE")]
    settings: Vec<String>,

    /// Description of this version, of up to 1,000 characters; `wildcity twin log` shows it.
    #[arg(long)]
    note: Option<String>,

    /// Refuse the push if, at any of four poses along the twin's drives, the PSNR between the
    /// images before and after the push is lower than this, in dB; or if no Gaussian is visible
    /// from any of them.
    #[arg(long, value_name = "DB")]
    min_psnr_db: Option<f64>,

    #[command(flatten)]
    bad: DropBad,
}

/// A coordinate frame, by its name on the wire.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum FrameName {
    Twin,
    Capture,
}

/// `--server` and its token, for every command that connects to a server.
#[derive(Debug, clap::Args)]
pub(super) struct Server {
    /// The server, as http://HOST:PORT.
    #[arg(long, value_name = "URL", default_value = limits::SERVER_URL)]
    server: String,

    /// File that holds the token [default: $WILDCITY_TOKEN, or none]
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
}

const EXAMPLES: &str = "\
Examples:
  wildcity push street.ply --twin street --axes y-down-z-forward
  wildcity push block7.spz block8.spz --twin city --server http://sim:8080 --token-file token
  wildcity push block7.ply --twin city --base 12 --cells 3,-1 --cells 4,-1
  wildcity push block7.ply --twin city --axes y-down-z-forward --frame capture   (city was aligned)";

impl Push {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let cells = match &self.cells[..] {
            [] => None,
            [all] if all == "all" => Some(CellSelection::All(AllCells::All)),
            cells if cells.iter().any(|cell| cell == "all") => {
                anyhow::bail!("--cells all replaces all cells: give it once, without other cells")
            }
            cells => Some(CellSelection::Listed(
                cells.iter().map(|text| parse_cell(text)).collect::<Result<_, _>>()?,
            )),
        };
        let client = self.server.client()?;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let pushed = runtime.block_on(self.push(&client, cells))?;
        let mut out = output::stdout();
        if let Some(report) = &pushed.report {
            print_report(&mut out, report)?;
        }
        match (pushed.state, pushed.version, pushed.error) {
            (PushState::Ready, Some(version), _) => {
                let hash = pushed.version_hash.unwrap_or_default();
                writeln!(out, "twin {} version {version} is ready\nblake3 {hash}", pushed.twin)?;
                if self.frame.is_none() && pushed.report.is_some_and(|report| report.aligned) {
                    let twin = pushed.twin;
                    writeln!(
                        io::stderr(),
                        "warning: twin {twin} was aligned, and the files were taken to be in its axes. If they are in \
                         the axes of its capture, roll back (wildcity twin rollback) and push with --frame capture; with \
                         --frame twin there is no warning"
                    )?;
                }
                Ok(())
            }
            (state, _, error) => {
                let why = error.map_or_else(String::new, |error| error.message);
                anyhow::bail!("the push was {}: {why}", state_name(state))
            }
        }
    }

    async fn push(
        &self,
        client: &HttpClient,
        cells: Option<CellSelection>,
    ) -> anyhow::Result<Pushed> {
        let files = upload_all(client, &self.files, self.axes.as_deref(), self.scale).await?;
        let asked = NewPush {
            // One id for this run: if an answer is lost, the client sends the same push again under
            // this id.
            id: Some(uuid::Uuid::now_v7().as_simple().to_string()),
            files,
            frame: self.frame.map(|frame| match frame {
                FrameName::Twin => PushFrame::Twin,
                FrameName::Capture => PushFrame::Capture,
            }),
            base: self.base,
            cells,
            record: self.record.clone(),
            levels: !self.no_lod,
            profile: self.settings.clone(),
            note: self.note.clone(),
            preview: PreviewRequest { poses: None, min_psnr_db: self.min_psnr_db },
            drop_bad: self.bad.drop_bad,
        };
        let begun = client.push(&self.twin, &asked).await?;
        let bar = progress::state();
        let on_status = &mut |push: &Pushed| {
            bar.set_message(state_name(push.state));
            bar.set_length(push.progress.total);
            bar.set_position(push.progress.done);
        };
        let ended = client.wait_for_push(begun, on_status).await?;
        bar.finish_and_clear();
        Ok(ended)
    }
}

/// Uploads files, with progress bars, and returns them in the form of a request. A folder with a
/// SOG becomes one archive.
pub(super) async fn upload_all(
    client: &HttpClient,
    paths: &[PathBuf],
    axes: Option<&str>,
    scale: Option<f64>,
) -> anyhow::Result<Vec<PushFile>> {
    let mut files = Vec::with_capacity(paths.len());
    for path in paths {
        let packed = packed_folder::pack(path, paths.len() == 1)?;
        let (upload, name) = match &packed {
            Some(packed) => (upload(client, packed.path()).await?, file_name(packed.path())),
            None => {
                let name = name_beside(paths, path).or_else(|| file_name(path));
                (upload(client, path).await?, name)
            }
        };
        files.push(PushFile { upload, axes: axes.map(str::to_owned), scale, name });
    }
    Ok(files)
}

/// Uploads a file, with a progress bar. Returns the id of the upload.
async fn upload(client: &HttpClient, path: &Path) -> anyhow::Result<String> {
    let bar = progress::bytes("uploading");
    let upload = client
        .upload(path, &mut progress::show(&bar))
        .await
        .with_context(|| format!("cannot upload {}", path.display()))?;
    bar.finish_and_clear();
    Ok(upload.id)
}

fn file_name(path: &Path) -> Option<String> {
    path.file_name().and_then(|name| name.to_str()).map(str::to_owned)
}

/// The path of a file relative to the folder of the first file, which names it so:
/// `textures/paint.png`. `None` if it is not in a folder below that one; then its own file name is
/// its name.
fn name_beside(files: &[PathBuf], path: &Path) -> Option<String> {
    let below = path.strip_prefix(files.first()?.parent()?).ok()?;
    let steps: Option<Vec<&str>> = below.iter().map(|step| step.to_str()).collect();
    steps.filter(|steps| steps.len() > 1).map(|steps| steps.join("/"))
}

impl Server {
    /// A client of the server, with the token.
    pub(super) fn client(&self) -> anyhow::Result<HttpClient> {
        let token = match &self.token_file {
            Some(path) => Some(read_token(path)?),
            None => std::env::var("WILDCITY_TOKEN").ok().filter(|token| !token.is_empty()),
        };
        Ok(HttpClient::new(&self.server, &ConnectOptions::with_token(token))?)
    }
}

fn read_token(path: &Path) -> anyhow::Result<String> {
    let cannot = || format!("--token-file {}", path.display());
    let text = ingest::read_whole(path, wildcity_server::limits::TOKENS_FILE_BYTES)
        .with_context(cannot)?;
    Ok(String::from_utf8(text).with_context(cannot)?.trim().to_owned())
}

/// Parses a cell, for example `3,-1`.
fn parse_cell(text: &str) -> anyhow::Result<[i32; 2]> {
    let parsed = text
        .split_once(',')
        .and_then(|(x, y)| Some([x.trim().parse().ok()?, y.trim().parse().ok()?]));
    parsed.with_context(|| format!("--cells {text:?} is neither all nor a cell, as 3,-1"))
}

fn print_report(out: &mut impl Write, report: &PushReport) -> io::Result<()> {
    for file in &report.files {
        writeln!(out, "file        {}: {} Gaussians", file.name, file.gaussians)?;
        for bad in &file.first_bad {
            let wildcity_protocol::http::BadGaussian { index, field, value, must } = bad;
            writeln!(out, "bad         Gaussian {index}: {field} is {value}; {must}")?;
        }
        if file.dropped > 0 {
            writeln!(out, "left out    {} Gaussians that cannot be drawn", file.dropped)?;
        }
        for warning in &file.warnings {
            writeln!(io::stderr(), "warning: {}: {warning}", file.name)?;
        }
        for assumed in &file.assumed {
            writeln!(io::stderr(), "note: {}: {assumed}", file.name)?;
        }
        let unnamed = file.bad - file.first_bad.len() as u64;
        if unnamed > 0 {
            writeln!(out, "bad         and {unnamed} more")?;
        }
    }
    let frame = match (report.frame, report.aligned) {
        (Some(PushFrame::Twin), true) => {
            "the twin's; it was aligned: files in the axes of its capture need --frame capture"
        }
        (Some(PushFrame::Capture), true) => {
            "the capture's; turned, moved and scaled as the twin was"
        }
        (Some(PushFrame::Capture), false) => {
            "the capture's, which is the twin's: this version records no alignment"
        }
        (Some(PushFrame::Twin), false) | (None, _) => "",
    };
    if !frame.is_empty() {
        writeln!(out, "frame       {frame}")?;
    }
    if let Some(ranges) = report.ranges {
        let [low, high] = ranges.mean_m;
        writeln!(out, "bounds      {low:.1?} to {high:.1?} m")?;
        let [thin, wide] = ranges.scale_m;
        writeln!(out, "scales      {thin:.2e} to {wide:.2e} m")?;
    }
    if !report.cells.is_empty() {
        let before: u64 = report.cells.iter().map(|cell| cell.before).sum();
        let after: u64 = report.cells.iter().map(|cell| cell.after).sum();
        let cells = report.cells.len();
        writeln!(out, "cells       {cells}, with {before} Gaussians before and {after} after")?;
    }
    if report.left_out > 0 {
        writeln!(out, "left out    {} Gaussians in other cells", report.left_out)?;
    }
    for preview in &report.previews {
        let [x, y, z] = preview.pose.xyz;
        let psnr = preview.psnr_db.map_or("equal".to_owned(), |db| format!("{db:.1} dB"));
        writeln!(out, "view        from ({x:.1}, {y:.1}, {z:.1}): {psnr}")?;
    }
    Ok(())
}

fn state_name(state: PushState) -> &'static str {
    match state {
        PushState::Queued => "queued",
        PushState::Ingesting => "ingesting",
        PushState::Validating => "validating",
        PushState::Committing => "committing",
        PushState::Prefetching => "prefetching",
        PushState::Ready => "ready",
        PushState::Refused => "refused",
        PushState::Failed => "stopped by a fault of the server",
    }
}

//! The ONNX runtime: the only file that names it.
//!
//! The library is opened once, when the first model is loaded, and a process has one environment.
//! Each model has a thread that builds its session and runs it, because the runtime can be asked to
//! stop but not be forced: a caller waits for an answer, never for the thread.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::thread;
use std::time::Duration;

use half::f16;
use ort::environment::Environment;
use ort::ep::cuda::ConvAlgorithmSearch;
use ort::logging::LogLevel;
use ort::session::builder::{GraphOptimizationLevel, SessionBuilder};
use ort::session::{NoSelectedOutputs, RunOptions, Session, SessionInputValue};
use ort::value::{DynValue, Outlet, Tensor, TensorElementType, ValueType};
use parking_lot::Mutex;

use crate::error::RepairError;
use crate::files::{self, GraphFiles};
use crate::limits::{MAX_TIMEOUTS, STOP_TIMEOUT};
use crate::manifest::{Dtype, Provider};

/// The library of this process.
struct Runtime {
    library: PathBuf,
    environment: Environment,
}

static RUNTIME: Mutex<Option<Runtime>> = Mutex::new(None);

/// Whether this process has loaded a runtime library.
pub fn is_loaded() -> bool {
    RUNTIME.lock().is_some()
}

/// The environment; opens the library if no model did before.
fn environment(path: &Path) -> Result<Environment, RepairError> {
    let refused = |message: String| RepairError::Runtime { path: path.to_owned(), message };
    if path.as_os_str().is_empty() {
        return Err(RepairError::RuntimeUnnamed);
    }
    let library = files::check_library(path).map_err(refused)?;
    // Held while the library is opened, so that two models cannot open two.
    let mut runtime = RUNTIME.lock();
    if let Some(runtime) = &*runtime {
        // The library's global state belongs to the process: a second one cannot be loaded.
        if runtime.library != library {
            let loaded = runtime.library.clone();
            return Err(RepairError::RuntimeLoaded { loaded, asked: library });
        }
        return Ok(runtime.environment.clone());
    }
    let builder = ort::init_from(&library).map_err(|error| {
        refused(format!("{error}; name a libonnxruntime.so from version 1.18 on"))
    })?;
    let environment = builder
        .with_name("wildcity")
        .with_telemetry(false)
        .build()
        .map_err(|error| refused(error.to_string()))?;
    // Errors come back as values; the runtime must not print them too.
    environment.set_log_level(LogLevel::Fatal);
    *runtime = Some(Runtime { library, environment: environment.clone() });
    Ok(environment)
}

/// Identity of the library: version, commit, compiler flags.
pub(crate) fn build_info() -> &'static str {
    ort::info()
}

/// Name of the library's file, such as `libonnxruntime.so.1.32.0`; empty before one is loaded.
pub(crate) fn library_name() -> String {
    let runtime = RUNTIME.lock();
    let name = runtime.as_ref().and_then(|runtime| runtime.library.file_name());
    name.map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

/// An input or output of a graph.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Port {
    pub(crate) name: String,
    /// `None` if the crate does not support the type.
    pub(crate) dtype: Option<Dtype>,
    /// The runtime's name of the type.
    pub(crate) type_name: String,
    /// -1 where any size is accepted.
    pub(crate) shape: Vec<i64>,
}

impl Port {
    fn new(outlet: &Outlet) -> Port {
        // A sequence, a map or an optional value: no type of the manifest.
        let ValueType::Tensor { ty, shape, .. } = outlet.dtype() else {
            let type_name = format!("{:?}", outlet.dtype());
            return Port {
                name: outlet.name().to_owned(),
                dtype: None,
                type_name,
                shape: Vec::new(),
            };
        };
        let dtype = match ty {
            TensorElementType::Float32 => Some(Dtype::F32),
            TensorElementType::Float16 => Some(Dtype::F16),
            TensorElementType::Int64 => Some(Dtype::I64),
            _ => None,
        };
        let shape = shape.iter().copied().collect();
        Port { name: outlet.name().to_owned(), dtype, type_name: format!("{ty:?}"), shape }
    }
}

/// Inputs and outputs of a graph.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Graph {
    pub(crate) inputs: Vec<Port>,
    pub(crate) outputs: Vec<Port>,
}

/// A value that goes into a graph.
#[derive(Clone, Debug)]
pub(crate) struct Feed {
    pub(crate) name: String,
    pub(crate) shape: Vec<i64>,
    pub(crate) dtype: Dtype,
    pub(crate) values: Vec<f32>,
}

/// A value that a graph returned.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Returned {
    pub(crate) shape: Vec<i64>,
    pub(crate) values: Vec<f32>,
}

/// Options for building a session.
#[derive(Clone, Debug)]
pub(crate) struct Settings {
    pub(crate) library: PathBuf,
    pub(crate) provider: Provider,
    pub(crate) threads: usize,
    /// Memory that a GPU provider may take.
    pub(crate) gpu_bytes: usize,
    pub(crate) load_timeout: Duration,
}

struct Job {
    feeds: Vec<Feed>,
    output: String,
    options: Arc<RunOptions<NoSelectedOutputs>>,
    answer: Sender<Result<Returned, String>>,
}

/// The thread of a model.
pub(crate) struct Worker {
    jobs: Sender<Job>,
    timeouts: u32,
    withdrawn: Option<String>,
}

impl Worker {
    /// Builds the session in a thread of its own, and waits for it.
    pub(crate) fn start(
        files: GraphFiles,
        settings: &Settings,
    ) -> Result<(Worker, Graph), RepairError> {
        let environment = environment(&settings.library)?;
        let path = files.path.clone();
        // One channel for the result of the build, another for the jobs that follow.
        let (ready, is_ready) = mpsc::channel();
        let (jobs, next_job) = mpsc::channel::<Job>();
        let session_settings = settings.clone();
        thread::Builder::new()
            .name("repair".to_owned())
            .spawn(move || match session(&environment, files, &session_settings) {
                Ok(session) => work(session, &ready, &next_job),
                // The caller may have given up and dropped the receiver.
                Err(error) => drop(ready.send(Err(error))),
            })
            .map_err(|error| RepairError::Run { message: format!("no thread: {error}") })?;
        let graph = match is_ready.recv_timeout(settings.load_timeout) {
            Ok(ready) => ready?,
            // The thread goes on building; it ends when it finds that nothing receives its result.
            Err(RecvTimeoutError::Timeout) => {
                let limit_s = settings.load_timeout.as_secs();
                return Err(RepairError::LoadTimeout { path, limit_s });
            }
            // The thread has panicked: an error would have been sent.
            Err(RecvTimeoutError::Disconnected) => {
                let message = "the thread of the session ended".to_owned();
                return Err(RepairError::Graph { path, message });
            }
        };
        Ok((Worker { jobs, timeouts: 0, withdrawn: None }, graph))
    }

    /// Whether no run will succeed any more.
    pub(crate) fn is_withdrawn(&self) -> bool {
        self.withdrawn.is_some()
    }

    /// Runs the graph and returns the output of that name. A run longer than `limit` is stopped.
    pub(crate) fn run(
        &mut self,
        feeds: Vec<Feed>,
        output: &str,
        limit: Duration,
    ) -> Result<Returned, RepairError> {
        // The thread may still be in the run that did not stop, and would take no other.
        if let Some(reason) = &self.withdrawn {
            return Err(RepairError::Withdrawn { reason: reason.clone() });
        }
        let failed = |message: String| RepairError::Run { message };
        let options = Arc::new(RunOptions::new().map_err(|error| failed(error.to_string()))?);
        // A channel for each job: the late answer of an earlier run cannot be taken for this one's.
        let (answer, answers) = mpsc::channel();
        let job = Job { feeds, output: output.to_owned(), options: Arc::clone(&options), answer };
        let ended = || failed("the thread of the session ended".to_owned());
        self.jobs.send(job).map_err(|_| ended())?;
        match answers.recv_timeout(limit) {
            Ok(returned) => returned.map_err(failed),
            Err(RecvTimeoutError::Disconnected) => Err(ended()),
            Err(RecvTimeoutError::Timeout) => Err(self.stop(&options, &answers, limit)),
        }
    }

    /// Asks a run to stop. It does between two nodes; if it does not, the model is withdrawn.
    fn stop(
        &mut self,
        options: &RunOptions<NoSelectedOutputs>,
        answers: &Receiver<Result<Returned, String>>,
        limit: Duration,
    ) -> RepairError {
        let limit_ms = limit.as_millis() as u64;
        // A refused request has the same effect as one that the run ignores.
        let _ = options.terminate();
        self.timeouts += 1;
        let reason = match answers.recv_timeout(STOP_TIMEOUT) {
            // Any answer shows that the thread is free again, be it a result or an error.
            Ok(_) if self.timeouts < MAX_TIMEOUTS => return RepairError::TimedOut { limit_ms },
            Ok(_) => format!("{MAX_TIMEOUTS} runs took longer than timeout_ms {limit_ms}"),
            Err(_) => format!("a run took longer than timeout_ms {limit_ms} and did not stop"),
        };
        self.withdrawn = Some(reason.clone());
        RepairError::Withdrawn { reason }
    }
}

fn session(
    environment: &Environment,
    files: GraphFiles,
    settings: &Settings,
) -> Result<Session, RepairError> {
    let path = files.path.clone();
    let refused = |message: String| match settings.provider {
        Provider::Cpu => RepairError::Graph { path, message },
        _ => RepairError::Provider { provider: settings.provider.name(), message },
    };
    let mut builder = match builder(environment, &files, settings) {
        Ok(builder) => builder,
        // A failure of the cpu provider can only be the graph's; with a GPU it is taken as
        // the provider's.
        Err(error) => return Err(refused(error.to_string())),
    };
    builder.commit_from_memory(&files.bytes).map_err(|error| refused(error.to_string()))
}

/// The options of a session: sequential nodes, a fixed number of threads, no fall-back to another
/// provider.
fn builder(
    environment: &Environment,
    files: &GraphFiles,
    settings: &Settings,
) -> ort::Result<SessionBuilder> {
    let mut builder = Session::builder(environment)?
        .with_optimization_level(GraphOptimizationLevel::All)?
        .with_parallel_execution(false)?
        .with_intra_threads(settings.threads)?
        .with_inter_threads(1)?
        // Waiting threads sleep: the renderer uses the same cores.
        .with_intra_op_spinning(false)?
        .with_deterministic_compute(true)?;
    for (name, bytes) in &files.weights {
        builder = builder.with_external_initializer_file_in_memory(name, Arc::clone(bytes))?;
    }
    let cuda = ort::ep::CUDA::default()
        .with_memory_limit(settings.gpu_bytes)
        // An exhaustive search measures times, and may choose another algorithm, and other
        // bits, each time.
        .with_conv_algorithm_search(ConvAlgorithmSearch::Heuristic)
        // TF32 keeps 10 bits of the mantissa, f32 has 23.
        .with_tf32(false)
        .build()
        .error_on_failure();
    let tensorrt = ort::ep::TensorRT::default()
        .with_max_workspace_size(settings.gpu_bytes)
        .build()
        .error_on_failure();
    let providers = match settings.provider {
        Provider::Cpu => return Ok(builder),
        Provider::Cuda => vec![cuda],
        // In the order of preference: nodes that TensorRT lacks go to CUDA, and none to the cpu.
        Provider::Tensorrt => vec![tensorrt, cuda],
    };
    Ok(builder.with_execution_providers(providers)?.with_disable_cpu_fallback()?)
}

/// The thread of a model: runs until the last `Worker` is gone.
fn work(mut session: Session, ready: &Sender<Result<Graph, RepairError>>, jobs: &Receiver<Job>) {
    let graph = Graph {
        inputs: session.inputs().iter().map(Port::new).collect(),
        outputs: session.outputs().iter().map(Port::new).collect(),
    };
    // The caller's time was over: the session is dropped, and with it its memory.
    if ready.send(Ok(graph)).is_err() {
        return;
    }
    for job in jobs {
        let returned = run(&mut session, job.feeds, &job.output, &job.options);
        // A caller that gave up does not listen.
        let _ = job.answer.send(returned);
    }
}

fn run(
    session: &mut Session,
    feeds: Vec<Feed>,
    output: &str,
    options: &RunOptions<NoSelectedOutputs>,
) -> Result<Returned, String> {
    let mut inputs: Vec<(String, SessionInputValue<'_>)> = Vec::new();
    for feed in feeds {
        let name = feed.name.clone();
        inputs.push((name, tensor(feed).map_err(|error| error.to_string())?.into()));
    }
    let outputs = session.run_with_options(inputs, options).map_err(|error| error.to_string())?;
    let value = outputs.get(output).ok_or("the output is missing")?;
    returned(value).map_err(|error| error.to_string())
}

fn tensor(feed: Feed) -> ort::Result<DynValue> {
    let Feed { shape, values, .. } = feed;
    Ok(match feed.dtype {
        Dtype::F32 => Tensor::from_array((shape, values))?.into_dyn(),
        Dtype::F16 => {
            let values: Vec<f16> = values.into_iter().map(f16::from_f32).collect();
            Tensor::from_array((shape, values))?.into_dyn()
        }
        Dtype::I64 => {
            // Constants such as a time step: whole numbers that f32 has exactly up to 2^24.
            let values: Vec<i64> = values.into_iter().map(|value| value as i64).collect();
            Tensor::from_array((shape, values))?.into_dyn()
        }
    })
}

fn returned(value: &DynValue) -> ort::Result<Returned> {
    if value.dtype().tensor_type() == Some(TensorElementType::Float16) {
        let (shape, values) = value.try_extract_tensor::<f16>()?;
        let values = values.iter().map(|value| value.to_f32()).collect();
        return Ok(Returned { shape: shape.iter().copied().collect(), values });
    }
    let (shape, values) = value.try_extract_tensor::<f32>()?;
    Ok(Returned { shape: shape.iter().copied().collect(), values: values.to_vec() })
}

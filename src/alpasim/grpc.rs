//! One unary gRPC method over HTTP/2. A generator would write the same for each method.
//!
//! The bytes of a request are counted as they arrive, its messages before they are decoded, and it
//! is decoded off the threads that answer.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use bytes::{Buf as _, Bytes};
use http_body::{Body as HttpBody, Frame, SizeHint};
use parking_lot::Mutex;
use tokio::time::Sleep;
use tonic::body::Body;
use tonic::codec::{Codec, DecodeBuf, Decoder};
use tonic::server::{Grpc, UnaryService};
use tonic::{Request, Response, Status};
use tonic_prost::ProstCodec;

use crate::door::{Connection, RequestBytes};
use crate::limits;
use crate::shape::{self, Counted};
use crate::wire::common::Empty;

/// A body of a request, as hyper receives it.
type Incoming = hyper::body::Incoming;

/// Receives the request, decodes it, calls `method`, and encodes its answer or its status.
pub(crate) async fn unary<Asked, Answer, Method, Answering>(
    connection: &Arc<Connection>,
    request: http::Request<Incoming>,
    method: Method,
) -> http::Response<Body>
where
    Asked: prost::Message + Counted + Default + Send + 'static,
    Answer: prost::Message + Default + Send + 'static,
    Method: FnOnce(Asked) -> Answering + Send,
    Answering: Future<Output = Result<Answer, Status>> + Send,
{
    let _running = connection.request();
    let held = Arc::new(Mutex::new(RequestBytes::default()));
    let request = request.map(|body| CountedBody {
        body,
        connection: connection.clone(),
        held: held.clone(),
        late: Box::pin(tokio::time::sleep(limits::RECEIVE)),
    });
    let mut grpc = Grpc::new(RawCodec::<Answer>::default())
        // tonic's default of 4 MiB for requests would refuse batches with many objects.
        .apply_max_message_size_config(Some(limits::MESSAGE_BYTES), Some(limits::MESSAGE_BYTES));
    let called = |bytes: Bytes| async move {
        let asked = decoded(bytes).await?;
        // Until here the request was there twice.
        drop(held);
        method(asked).await
    };
    grpc.unary(Once(Some(called)), request).await
}

/// The message of a request.
async fn decoded<Asked>(bytes: Bytes) -> Result<Asked, Status>
where
    Asked: prost::Message + Counted + Default + Send + 'static,
{
    let decode = move || {
        shape::check::<Asked>(&bytes)?;
        Asked::decode(bytes).map_err(|error| Status::invalid_argument(error.to_string()))
    };
    tokio::task::spawn_blocking(decode)
        .await
        .map_err(|error| Status::internal(error.to_string()))?
}

/// The answer to a method that does not exist.
pub(crate) fn unimplemented(path: &str) -> http::Response<Body> {
    let end = path.floor_char_boundary(limits::SCENE_ID_BYTES);
    Status::unimplemented(format!("there is no method {}", &path[..end])).into_http()
}

/// A body whose bytes are counted, and which has a time.
struct CountedBody {
    body: Incoming,
    connection: Arc<Connection>,
    held: Arc<Mutex<RequestBytes>>,
    late: Pin<Box<Sleep>>,
}

impl HttpBody for CountedBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let frame = match Pin::new(&mut self.body).poll_frame(context) {
            Poll::Ready(Some(Ok(frame))) => frame,
            Poll::Ready(Some(Err(error))) => {
                return Poll::Ready(Some(Err(Status::cancelled(error.to_string()))));
            }
            Poll::Ready(None) => return Poll::Ready(None),
            Poll::Pending => {
                // A client that stops in the middle of its message.
                let late = self.late.as_mut().poll(context);
                return late.map(|()| {
                    let text = format!("the request took longer than {:?}", limits::RECEIVE);
                    Some(Err(Status::deadline_exceeded(text)))
                });
            }
        };
        let bytes = frame.data_ref().map_or(0, Bytes::len);
        match self.connection.reserve(bytes) {
            Ok(more) => {
                self.held.lock().merge(more);
                Poll::Ready(Some(Ok(frame)))
            }
            Err(status) => Poll::Ready(Some(Err(status))),
        }
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// Encodes answers, and leaves requests as they are.
struct RawCodec<Answer>(ProstCodec<Answer, Empty>);

impl<Answer> Default for RawCodec<Answer> {
    fn default() -> Self {
        Self(ProstCodec::new())
    }
}

impl<Answer: prost::Message + Send + 'static> Codec for RawCodec<Answer> {
    type Encode = Answer;
    type Decode = Bytes;
    type Encoder = <ProstCodec<Answer, Empty> as Codec>::Encoder;
    type Decoder = RawDecoder;

    fn encoder(&mut self) -> Self::Encoder {
        self.0.encoder()
    }

    fn decoder(&mut self) -> RawDecoder {
        RawDecoder
    }
}

/// Hands out the bytes of a message.
struct RawDecoder;

impl Decoder for RawDecoder {
    type Item = Bytes;
    type Error = Status;

    fn decode(&mut self, source: &mut DecodeBuf<'_>) -> Result<Option<Bytes>, Status> {
        Ok(Some(source.copy_to_bytes(source.remaining())))
    }
}

/// A method that is called once, as tonic's service.
struct Once<Method>(Option<Method>);

impl<Answer, Method, Answering> UnaryService<Bytes> for Once<Method>
where
    Method: FnOnce(Bytes) -> Answering,
    Answering: Future<Output = Result<Answer, Status>>,
{
    type Response = Answer;
    type Future = AsResponse<Answering>;

    fn call(&mut self, request: Request<Bytes>) -> Self::Future {
        // `call` takes `&mut self`, and the method can be called once only, so it is taken out.
        let called = self.0.take().map(|method| method(request.into_inner()));
        AsResponse(called.map(Box::pin))
    }
}

/// A future of an answer as a future of a response.
struct AsResponse<Answering>(Option<Pin<Box<Answering>>>);

impl<Answer, Answering> Future for AsResponse<Answering>
where
    Answering: Future<Output = Result<Answer, Status>>,
{
    type Output = Result<Response<Answer>, Status>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        match &mut self.0 {
            Some(answering) => answering.as_mut().poll(context).map_ok(Response::new),
            // tonic calls a unary service once for each request.
            None => Poll::Ready(Err(Status::internal("a method was called twice"))),
        }
    }
}

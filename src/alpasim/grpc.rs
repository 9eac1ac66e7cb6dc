//! One unary gRPC method over HTTP/2. A generator would write the same for each method.

use std::future::Future;

use tonic::body::Body;
use tonic::server::{Grpc, UnaryService};
use tonic::{Request, Response, Status};
use tonic_prost::ProstCodec;

use crate::limits;

/// A body of a request, as hyper receives it.
type Incoming = hyper::body::Incoming;

/// Decodes the request, calls `method`, and encodes its answer or its status.
pub async fn unary<Asked, Answer, Method, Answering>(
    request: http::Request<Incoming>,
    method: Method,
) -> http::Response<Body>
where
    Asked: prost::Message + Default + Send + 'static,
    Answer: prost::Message + Default + Send + 'static,
    Method: FnOnce(Asked) -> Answering + Send,
    Answering: Future<Output = Result<Answer, Status>> + Send,
{
    let codec = ProstCodec::<Answer, Asked>::default();
    let mut grpc = Grpc::new(codec)
        // tonic's default of 4 MiB for requests would refuse batches with many objects.
        .apply_max_message_size_config(Some(limits::MESSAGE_BYTES), Some(limits::MESSAGE_BYTES));
    grpc.unary(Once(Some(method)), request).await
}

/// The answer to a method that does not exist.
pub fn unimplemented(path: &str) -> http::Response<Body> {
    Status::unimplemented(format!("there is no method {path}")).into_http()
}

/// A method that is called once, as tonic's service.
struct Once<Method>(Option<Method>);

impl<Asked, Answer, Method, Answering> UnaryService<Asked> for Once<Method>
where
    Method: FnOnce(Asked) -> Answering,
    Answering: Future<Output = Result<Answer, Status>>,
{
    type Response = Answer;
    type Future = AsResponse<Answering>;

    fn call(&mut self, request: Request<Asked>) -> Self::Future {
        // `call` takes `&mut self`, and the method can be called once only, so it is taken out.
        let called = self.0.take().map(|method| method(request.into_inner()));
        AsResponse(called.map(Box::pin))
    }
}

/// A future of an answer as a future of a response.
pub struct AsResponse<Answering>(Option<std::pin::Pin<Box<Answering>>>);

impl<Answer, Answering> Future for AsResponse<Answering>
where
    Answering: Future<Output = Result<Answer, Status>>,
{
    type Output = Result<Response<Answer>, Status>;

    fn poll(
        mut self: std::pin::Pin<&mut Self>,
        context: &mut std::task::Context<'_>,
    ) -> std::task::Poll<Self::Output> {
        match &mut self.0 {
            Some(answering) => answering.as_mut().poll(context).map_ok(Response::new),
            // tonic calls a unary service once for each request.
            None => std::task::Poll::Ready(Err(Status::internal("a method was called twice"))),
        }
    }
}

"""HTTP server for chat completions that answers from a script."""

import contextlib
import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


def completion(text, finish="stop"):
    """Return a response body in the format of chat endpoints."""
    return {
        "model": "scripted-1",
        "choices": [{"message": {"role": "assistant", "content": text}, "finish_reason": finish}],
        "usage": {"prompt_tokens": 11, "completion_tokens": len(text.split())},
    }


class ChatServer:
    """Server that answers with the entries of ``script``, a text or (status, headers, body, seconds), and repeats the last."""

    def __init__(self, *script):
        self.script = list(script)
        self.requests = []
        self.most_at_once = 0
        self._now = 0
        self._lock = threading.Lock()

    def next_answer(self, request):
        with self._lock:
            self.requests.append(request)
            answer = self.script.pop(0) if len(self.script) > 1 else self.script[0]
        return answer if isinstance(answer, tuple) else (200, {}, json.dumps(completion(answer)), 0.0)

    @contextlib.contextmanager
    def counted(self):
        with self._lock:
            self._now += 1
            self.most_at_once = max(self.most_at_once, self._now)
        try:
            yield
        finally:
            with self._lock:
                self._now -= 1

    @contextlib.contextmanager
    def serving(self):
        """Serve until the block ends; yields the base URL."""
        script = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                length = int(self.headers["content-length"])
                request = json.loads(self.rfile.read(length))
                request["_authorization"] = self.headers.get("authorization", "")
                request["_path"] = self.path
                with script.counted():
                    status, headers, body, seconds = script.next_answer(request)
                    time.sleep(seconds)
                    data = body.encode() if isinstance(body, str) else body
                    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                        self.send_response(status)
                        for name, value in headers.items():
                            self.send_header(name, value)
                        self.send_header("content-length", str(len(data)))
                        self.end_headers()
                        self.wfile.write(data)

            def log_message(self, *_):
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/v1"
        finally:
            server.shutdown()
            server.server_close()
            thread.join()

"""HTTP server with the request forms of vLLM and SGLang in front of a small Hugging Face model.

Its sampling is written without the trainer's code: each token takes one forward pass over the whole text.
"""

import contextlib
import copy
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import torch

VLLM, SGLANG = "vllm", "sglang"


class RefusedError(Exception):
    """Request that the server answers with this status and text."""

    def __init__(self, status, text):
        super().__init__(text)
        self.status = status


class ServedLlama:
    """Server of the model in ``folder``. ``calls`` are the answered requests: path, body and answer.

    ``loaded`` are the weights that it got, by name. ``faults`` are missing abilities: ``logprobs``, ``token_ids``,
    ``adapters`` and ``temperature`` (log-probabilities at temperature 1). The server stops while it answers the request for
    plans with the number ``dies_at``; then ``alive`` is false. While ``hold`` is not set, no request is answered. Every answer
    names ``forced_version`` as the weights' version if there is one. ``shift`` is added to each log-probability.
    """

    def __init__(self, folder, kind=VLLM, *, context=1024, faults=(), dies_at=None, shift=0.0):
        from transformers import AutoModelForCausalLM, AutoTokenizer

        self._model = AutoModelForCausalLM.from_pretrained(folder).eval()
        self._tokenizer = AutoTokenizer.from_pretrained(folder)
        self._kind, self._context, self._faults, self._dies_at = kind, context, faults, dies_at
        self._shift = shift
        self._adapted = {}
        self._draws = 0
        self._lock = threading.Lock()
        self.version = "default"
        self.forced_version = ""
        self.alive = True
        self.loaded = {}
        self.calls = []
        self.hold = threading.Event()
        self.hold.set()

    def bodies(self, path):
        """Return the bodies of the answered requests to a path, oldest first."""
        return [body for at, body, _ in self.calls if at == path]

    @property
    def adapters(self):
        return set(self._adapted)

    @contextlib.contextmanager
    def serving(self, port=0):
        """Serve until the block ends; yields the address."""
        served = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                self._answer({"data": served.models()} if self.path == "/v1/models" else None)

            def do_POST(self):
                body = json.loads(self.rfile.read(int(self.headers["content-length"])))
                served.hold.wait()
                try:
                    with served._lock:
                        answer = served.answer(self.path, body)
                        served.calls.append((self.path, body, answer))
                except RefusedError as error:
                    self._answer({"error": {"message": str(error)}}, error.status)
                except ConnectionAbortedError:
                    server.shutdown()
                    server.server_close()
                    served.alive = False
                    self.close_connection = True
                else:
                    self._answer(answer)

            def _answer(self, value, status=200):
                data = json.dumps(value).encode()
                with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                    self.send_response(404 if value is None else status)
                    self.send_header("content-length", str(len(data)))
                    self.end_headers()
                    self.wfile.write(data)

            def log_message(self, *_):
                pass

        server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            self.hold.set()
            server.shutdown()
            server.server_close()
            thread.join()

    def models(self):
        base = {"id": "random-llama", "max_model_len": self._context}
        return [base, *({"id": name, "parent": base["id"]} for name in self._adapted)]

    def answer(self, path, body):
        paths = {
            VLLM: {
                "/v1/completions": self._completions,
                "/v1/load_lora_adapter": self._load,
                "/v1/unload_lora_adapter": self._unload,
            },
            SGLANG: {
                "/generate": self._generate,
                "/load_lora_adapter": self._load,
                "/unload_lora_adapter": self._unload,
                "/update_weights_from_disk": self._update,
            },
        }[self._kind]
        if path not in paths or ("adapters" in self._faults and "lora" in path):
            raise RefusedError(404, "Not Found")
        return paths[path](body)

    def _load(self, body):
        from peft import PeftModel

        name = body["lora_name"]
        if name in self._adapted:
            raise RefusedError(400, f"The lora adapter '{name}' has already been loaded.")
        model = PeftModel.from_pretrained(copy.deepcopy(self._model), body["lora_path"]).eval()
        self._adapted[name] = model
        self.loaded[name] = {key: tensor for key, tensor in model.state_dict().items() if "lora_" in key}
        return {"success": True}

    def _unload(self, body):
        if self._adapted.pop(body["lora_name"], None) is None:
            raise RefusedError(404, f"The lora adapter '{body['lora_name']}' cannot be found.")
        return {"success": True}

    def _update(self, body):
        from transformers import AutoModelForCausalLM

        self._model = AutoModelForCausalLM.from_pretrained(body["model_path"]).eval()
        self.version = body["weight_version"]
        self.loaded[self.version] = self._model.state_dict()
        return {"success": True, "message": "", "num_paused_requests": 0}

    def _completions(self, body):
        if body["model"] not in self._adapted:
            raise RefusedError(404, f"The model `{body['model']}` does not exist.")
        generator = torch.Generator().manual_seed(body["seed"] % 2**63)
        choices = []
        for prompt in body["prompt"]:
            for _ in range(body["n"]):
                tokens, logprobs, finish = self._draw(
                    self._adapted[body["model"]], prompt, body, body["max_tokens"], generator
                )
                choice = {
                    "index": len(choices),
                    "text": self._tokenizer.decode(tokens, skip_special_tokens=True),
                    "finish_reason": finish,
                    "logprobs": {
                        "tokens": [f"token_id:{token}" for token in tokens],
                        "token_logprobs": logprobs,
                        "top_logprobs": [{} for _ in tokens],
                    },
                    "token_ids": tokens,
                }
                if "logprobs" in self._faults:
                    choice["logprobs"] = None
                if "token_ids" in self._faults:
                    del choice["token_ids"]
                    choice["logprobs"]["tokens"] = self._tokenizer.convert_ids_to_tokens(tokens)
                choices.append(choice)
        choices.reverse()  # the index of a choice gives its place
        return {"object": "text_completion", "choices": choices}

    def _generate(self, body):
        model = self._model
        if "lora_path" in body:
            if body["lora_path"] not in self._adapted:
                raise RefusedError(400, f"Got LoRA adapter that has never been loaded: {body['lora_path']}")
            model = self._adapted[body["lora_path"]]
        generator = torch.Generator().manual_seed(self._draws)
        answers = []
        for prompt in body["input_ids"]:
            wanted = body["sampling_params"]
            tokens, logprobs, finish = self._draw(model, prompt, wanted, wanted["max_new_tokens"], generator)
            meta = {"finish_reason": {"type": finish}, "weight_version": self.forced_version or self.version}
            if body.get("return_logprob") and "logprobs" not in self._faults:
                pairs = zip(logprobs, tokens, strict=True)
                meta["output_token_logprobs"] = [[logprob, token, None] for logprob, token in pairs]
            answers.append({"text": "", "output_ids": tokens, "meta_info": meta})
        return answers

    @torch.no_grad()
    def _draw(self, model, prompt, wanted, longest, generator):
        self._draws += 1
        if self._dies_at is not None and self._draws >= self._dies_at:
            raise ConnectionAbortedError
        temperature, ids, logprobs = wanted["temperature"], list(prompt), []
        while len(logprobs) < longest:
            scores = model(torch.tensor([ids])).logits[0, -1].float()
            drawn = torch.multinomial(torch.softmax(scores / temperature, dim=0), 1, generator=generator)
            scale = 1.0 if "temperature" in self._faults else temperature
            ids.append(int(drawn))
            logprobs.append(float(torch.log_softmax(scores / scale, dim=0)[drawn]) + self._shift)
            if ids[-1] in wanted["stop_token_ids"]:
                return ids[len(prompt) :], logprobs, "stop"
        return ids[len(prompt) :], logprobs, "length"

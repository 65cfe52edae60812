"""Manager process with settings that the command line does not offer: ``python manager_process.py JSON``."""

import asyncio
import logging
import sys

from embomatrix.manager.services.app import serve
from embomatrix.manager.settings import ManagerSettings
from embomatrix.manager.store.protocol import StateError


def main():
    logging.basicConfig(level=logging.INFO, format="%(created).3f %(name)s %(message)s")
    try:
        asyncio.run(serve(ManagerSettings.model_validate_json(sys.argv[1]), lambda endpoints: None))
    except* StateError as group:
        error = group
        while isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        sys.exit(f"manager ends: {error}")


if __name__ == "__main__":
    main()

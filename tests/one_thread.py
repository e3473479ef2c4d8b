"""Libraries that are loaded after this have one thread each, as in jobs: threads that wait for each other spin."""

from snakesfm.job import limit_library_threads

limit_library_threads()

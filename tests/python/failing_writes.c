/* Makes one change of files below FAULT_ROOT fail with "no space left": the one whose number is FAULT_AT, counted from 1, and all
   after it if FAULT_DIES is set, as on a disk that stays full. Counts into the file FAULT_COUNT. Preloaded by test_failing_writes.py. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static int count;

static int below(const char *path) {
    const char *root = getenv("FAULT_ROOT");
    char whole[8192];
    if (!root || !path) return 0;
    if (path[0] != '/') {
        char here[4096];
        if (!getcwd(here, sizeof here)) return 0;
        snprintf(whole, sizeof whole, "%s/%s", here, path);
        path = whole;
    }
    return !strncmp(path, root, strlen(root));
}

static int fails(void) {
    const char *at = getenv("FAULT_AT"), *note = getenv("FAULT_COUNT");
    int number = __atomic_add_fetch(&count, 1, __ATOMIC_SEQ_CST);
    if (note) {
        FILE *file = fopen(note, "w");
        if (file) { fprintf(file, "%d", number); fclose(file); }
    }
    if (at && (number == atoi(at) || (getenv("FAULT_DIES") && number > atoi(at)))) {
        errno = ENOSPC;
        return 1;
    }
    return 0;
}

static int below_descriptor(int file) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0) return 0;
    path[length] = 0;
    return below(path);
}

#define REAL(name, type, ...) static type (*real)(__VA_ARGS__); if (!real) real = dlsym(RTLD_NEXT, #name)
#define WRITES(flags) ((flags) & (O_CREAT | O_TRUNC))

#define OPEN(name) \
    int name(const char *path, int flags, ...) { \
        REAL(name, int, const char *, int, ...); \
        va_list rest; va_start(rest, flags); \
        mode_t mode = (flags & (O_CREAT | O_TMPFILE)) ? va_arg(rest, mode_t) : 0; \
        va_end(rest); \
        return WRITES(flags) && below(path) && fails() ? -1 : real(path, flags, mode); \
    }
OPEN(open)
OPEN(open64)

ssize_t write(int file, const void *bytes, size_t length) {
    REAL(write, ssize_t, int, const void *, size_t);
    if (file > 2 && below_descriptor(file) && fails()) return -1;
    return real(file, bytes, length);
}

int fsync(int file) {
    REAL(fsync, int, int);
    return below_descriptor(file) && fails() ? -1 : real(file);
}

int mkdir(const char *path, mode_t mode) {
    REAL(mkdir, int, const char *, mode_t);
    return below(path) && fails() ? -1 : real(path, mode);
}

int rename(const char *from, const char *to) {
    REAL(rename, int, const char *, const char *);
    return below(to) && fails() ? -1 : real(from, to);
}

int linkat(int a, const char *from, int b, const char *to, int flags) {
    REAL(linkat, int, int, const char *, int, const char *, int);
    return below(to) && fails() ? -1 : real(a, from, b, to, flags);
}

int symlink(const char *target, const char *at) {
    REAL(symlink, int, const char *, const char *);
    return below(at) && fails() ? -1 : real(target, at);
}

int unlink(const char *path) {
    REAL(unlink, int, const char *);
    return below(path) && fails() ? -1 : real(path);
}

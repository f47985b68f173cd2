/* Stands in for a kernel with CAN, for one test: a raw CAN socket becomes a connection to the Unix socket that CAN_SHIM
 * names, on which frames go as the 16 bytes of struct can_frame. Preloaded; knows one interface, vcan0. CAN_SHIM_SOCKET and
 * CAN_SHIM_WRITE are error numbers with which that call fails; an open() of SHIM_PATH fails with SHIM_OPEN. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <net/if.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

enum { INTERFACE = 7 };
static int shimmed = -1;

/* The error number that a variable has. */
static int failure(const char *name)
{
    const char *number = getenv(name);
    return number ? atoi(number) : 0;
}

static int is_denied(const char *path)
{
    const char *denied = getenv("SHIM_PATH");
    return denied && strcmp(path, denied) == 0;
}

int open(const char *path, int flags, ...)
{
    int (*real)(const char *, int, ...) = (int (*)(const char *, int, ...))dlsym(RTLD_NEXT, "open");
    va_list more;
    va_start(more, flags);
    int mode = va_arg(more, int);
    va_end(more);
    if (!is_denied(path))
        return real(path, flags, mode);
    errno = failure("SHIM_OPEN");
    return -1;
}

int open64(const char *path, int flags, ...)
{
    int (*real)(const char *, int, ...) = (int (*)(const char *, int, ...))dlsym(RTLD_NEXT, "open64");
    va_list more;
    va_start(more, flags);
    int mode = va_arg(more, int);
    va_end(more);
    if (!is_denied(path))
        return real(path, flags, mode);
    errno = failure("SHIM_OPEN");
    return -1;
}

ssize_t send(int fd, const void *bytes, size_t len, int flags)
{
    ssize_t (*real)(int, const void *, size_t, int) =
        (ssize_t (*)(int, const void *, size_t, int))dlsym(RTLD_NEXT, "send");
    if (fd != shimmed || shimmed < 0 || !failure("CAN_SHIM_WRITE"))
        return real(fd, bytes, len, flags);
    errno = failure("CAN_SHIM_WRITE");
    return -1;
}

int socket(int domain, int type, int protocol)
{
    int (*real)(int, int, int) = (int (*)(int, int, int))dlsym(RTLD_NEXT, "socket");
    const char *path = getenv("CAN_SHIM");
    if (domain != AF_CAN || !path)
        return real(domain, type, protocol);
    if (failure("CAN_SHIM_SOCKET")) {
        errno = failure("CAN_SHIM_SOCKET");
        return -1;
    }
    int fd = real(AF_UNIX, SOCK_STREAM | (type & (SOCK_CLOEXEC | SOCK_NONBLOCK)), 0);
    struct sockaddr_un address = { .sun_family = AF_UNIX };
    strncpy(address.sun_path, path, sizeof address.sun_path - 1);
    if (fd >= 0 && connect(fd, (struct sockaddr *)&address, sizeof address) == 0)
        shimmed = fd;
    return fd;
}

int bind(int fd, const struct sockaddr *address, socklen_t len)
{
    int (*real)(int, const struct sockaddr *, socklen_t) =
        (int (*)(int, const struct sockaddr *, socklen_t))dlsym(RTLD_NEXT, "bind");
    return fd == shimmed ? 0 : real(fd, address, len);
}

int setsockopt(int fd, int level, int name, const void *value, socklen_t len)
{
    int (*real)(int, int, int, const void *, socklen_t) =
        (int (*)(int, int, int, const void *, socklen_t))dlsym(RTLD_NEXT, "setsockopt");
    /* SOL_CAN_BASE and above. */
    return fd == shimmed && level >= 100 ? 0 : real(fd, level, name, value, len);
}

unsigned int if_nametoindex(const char *name)
{
    if (strcmp(name, "vcan0") == 0)
        return INTERFACE;
    errno = ENODEV;
    return 0;
}
